/** The bundle for three dimensions, which is loaded when it is first wanted. */
import type { Scenes } from "./scene/index";

let loaded: Promise<Scenes> | null = null;

export function loadScenes(): Promise<Scenes> {
  loaded ??= new Promise((resolve, reject) => {
    const script = document.createElement("script");
    const done = () => resolve((globalThis as unknown as { flcavScene: Scenes }).flcavScene);
    const inside = document.getElementById("scene")?.textContent; // in a saved page
    if (inside) script.text = inside;
    else script.src = "scene.js";
    script.onload = done;
    script.onerror = () => [(loaded = null), reject(new Error("The view in three dimensions could not be loaded."))];
    document.head.append(script);
    if (inside) done();
  });
  return loaded;
}
