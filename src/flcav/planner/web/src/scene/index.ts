/** The bundle `scene.js`: views in three dimensions, for the planner, and for any page that has a sweep as JSON.
 *
 * A page that is no planner writes `<div class="flcav-sweep" data-from="ID">` and `<script type="application/json" id="ID">`
 * with a `SweepData`, and then this script: see docs/planner.md.
 */
import { SweepScene, tellSweep, type SweepData } from "./sweep";
import { TownScene } from "./town";

export type Scenes = { TownScene: typeof TownScene; SweepScene: typeof SweepScene; tellSweep: typeof tellSweep };

(globalThis as unknown as { flcavScene: Scenes }).flcavScene = { TownScene, SweepScene, tellSweep };

/** Draw a sweep in its element, in place of what stands there with `data-fallback`, anew when the colours change. */
function show(host: HTMLElement) {
  const data = JSON.parse(document.getElementById(host.dataset.from!)!.textContent!) as SweepData;
  const fallbacks = host.querySelectorAll<HTMLElement>("[data-fallback]");
  const say = (text: string) => host.append(Object.assign(document.createElement("p"), { textContent: text }));
  let made: SweepScene | null = null;
  const draw = () => {
    made?.dispose();
    host.classList.add("drawn"); // its height may depend on it
    try {
      made = new SweepScene(host, data);
      made.shareWheel();
      fallbacks.forEach((each) => (each.hidden = true));
    } catch (error) {
      host.classList.remove("drawn");
      say((error as Error).message);
    }
  };
  draw();
  if (made) matchMedia("(prefers-color-scheme: dark)").addEventListener("change", draw);
}

document.querySelectorAll<HTMLElement>(".flcav-sweep[data-from]").forEach(show);
