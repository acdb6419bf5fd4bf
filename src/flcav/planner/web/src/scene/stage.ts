/** A canvas with a camera that orbits: what both views in three dimensions have in common. */
import { Color, DirectionalLight, HemisphereLight, PerspectiveCamera, Scene, Vector3, WebGLRenderer } from "three";
import { OrbitControls } from "three/examples/jsm/controls/OrbitControls.js";

export class NoWebGL extends Error {}

/** Return the colour of a CSS variable of an element, or a default where the page has none. */
export function colourOf(host: Element, name: string, otherwise: string): string {
  return getComputedStyle(host).getPropertyValue(`--${name}`).trim() || otherwise;
}

export class Stage {
  readonly scene = new Scene();
  readonly camera = new PerspectiveCamera(45, 1, 0.5, 6000);
  readonly renderer: WebGLRenderer;
  readonly controls: OrbitControls;
  onMove: () => void = () => {};
  private asked = 0;
  private readonly watch: ResizeObserver;
  private readonly host: HTMLElement;
  private readonly paint: (stage: Stage, width: number, height: number) => void;

  /** `paint` draws the scene on a canvas of a size [px]; `label` tells readers of screens what is shown. */
  constructor(host: HTMLElement, label: string, paint: (stage: Stage, width: number, height: number) => void) {
    this.host = host;
    this.paint = paint;
    try {
      this.renderer = new WebGLRenderer({ antialias: true, preserveDrawingBuffer: true });
    } catch {
      throw new NoWebGL("This browser cannot draw in three dimensions: it has no WebGL.");
    }
    this.renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
    const canvas = this.renderer.domElement;
    Object.assign(canvas.style, { display: "block", width: "100%", height: "100%", touchAction: "none" });
    canvas.setAttribute("role", "img");
    canvas.setAttribute("aria-label", label);
    canvas.tabIndex = 0;
    host.appendChild(canvas);
    this.camera.up.set(0, 0, 1);
    this.controls = new OrbitControls(this.camera, canvas);
    this.controls.maxPolarAngle = 1.5;
    this.controls.addEventListener("change", () => this.draw());
    canvas.addEventListener("keydown", (event) => this.turn(event));
    this.scene.add(new HemisphereLight(0xffffff, 0xb8b2a6, 2.4));
    const sun = new DirectionalLight(0xffffff, 1.3);
    sun.position.set(0.4, -0.7, 1);
    this.scene.add(sun);
    this.scene.background = new Color(colourOf(host, "sky", "#e4e6e8"));
    this.watch = new ResizeObserver(() => this.fit());
    this.watch.observe(host);
  }

  /** Look at a place [m] from a distance [m], `up` and `around` in radians. */
  look(at: [number, number, number], far: number, up: number, around: number) {
    this.controls.target.set(...at);
    const flat = far * Math.cos(up);
    this.camera.position.set(at[0] - flat * Math.cos(around), at[1] - flat * Math.sin(around), at[2] + far * Math.sin(up));
    this.controls.update();
    this.fit();
  }

  draw() {
    if (!this.asked)
      this.asked = requestAnimationFrame(() => {
        this.asked = 0;
        performance.mark("scene-drawn");
        this.paint(this, this.host.clientWidth, this.host.clientHeight);
        performance.measure("scene", "scene-drawn");
        this.onMove();
      });
  }

  /** Move around by keys: arrows turn, + and - go nearer and away. */
  private turn(event: KeyboardEvent) {
    const { target } = this.controls;
    const away = this.camera.position.clone().sub(target);
    const by = 0.1;
    if (event.key === "ArrowLeft" || event.key === "ArrowRight") away.applyAxisAngle(new Vector3(0, 0, 1), event.key === "ArrowLeft" ? -by : by);
    else if (event.key === "ArrowUp" || event.key === "ArrowDown") {
      const up = Math.atan2(away.z, Math.hypot(away.x, away.y));
      const next = Math.min(Math.max(up + (event.key === "ArrowUp" ? by : -by), 0.08), 1.55);
      const [far, flat] = [away.length(), Math.hypot(away.x, away.y)];
      away.set((away.x / flat) * far * Math.cos(next), (away.y / flat) * far * Math.cos(next), far * Math.sin(next));
    } else if (event.key === "+" || event.key === "-") away.multiplyScalar(event.key === "+" ? 0.85 : 1.18);
    else return;
    event.preventDefault();
    event.stopPropagation();
    this.camera.position.copy(target).add(away);
    this.controls.update();
    this.draw();
  }

  private fit() {
    const { clientWidth: width, clientHeight: height } = this.host;
    if (!width || !height) return;
    this.renderer.setSize(width, height, false);
    this.camera.aspect = width / height;
    this.camera.updateProjectionMatrix();
    this.draw();
  }

  dispose() {
    cancelAnimationFrame(this.asked);
    this.watch.disconnect();
    this.controls.dispose();
    this.renderer.dispose();
    this.renderer.forceContextLoss();
    this.renderer.domElement.remove();
  }
}
