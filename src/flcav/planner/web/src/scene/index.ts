/** The bundle `scene.js`: views in three dimensions, for the planner, and for any page that has a sweep as JSON.
 *
 * A page that is no planner writes `<div class="flcav-sweep" data-from="ID">` and `<script type="application/json" id="ID">`
 * with a `SweepData`, and then this script: see docs/planner.md.
 */
import { SweepScene, tellSweep, type SweepData } from "./sweep";
import { TownScene } from "./town";

export type Scenes = { TownScene: typeof TownScene; SweepScene: typeof SweepScene; tellSweep: typeof tellSweep };

(globalThis as unknown as { flcavScene: Scenes }).flcavScene = { TownScene, SweepScene, tellSweep };

for (const host of document.querySelectorAll<HTMLElement>(".flcav-sweep[data-from]")) {
  const data = JSON.parse(document.getElementById(host.dataset.from!)!.textContent!) as SweepData;
  try {
    new SweepScene(host, data);
  } catch (error) {
    host.textContent = (error as Error).message;
  }
}
