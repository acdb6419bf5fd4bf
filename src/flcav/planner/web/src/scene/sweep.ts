/** A LiDAR sweep before and after training, in three dimensions: its points, and boxes by outcome. */
import { BufferAttribute, BufferGeometry, Color, Group, LineBasicMaterial, LineSegments, Mesh, MeshBasicMaterial, Points, PointsMaterial, Scene } from "three";
import { colourOf, Stage } from "./stage";

export type Box = [number, number, number, number, number, number, number]; // centre x, y, z, length, width, height [m], yaw [rad]
export type Detections = { title: string; boxes: Box[]; hit: boolean[]; found: boolean[] };
/** All in one frame: x forward, y left [m]. */
export type SweepData = {
  points: string; // base64 of little-endian int16: x, y, z of each point [cm]
  ground: number; // z of the ground [m]
  targets: Box[];
  before: Detections;
  after: Detections;
  mark?: [number, number, number]; // a place that is marked
};

const LOW_M = 0.25; // returns below this height above the ground are drawn as ground
const EDGES = [0, 1, 1, 2, 2, 3, 3, 0, 4, 5, 5, 6, 6, 7, 7, 4, 0, 4, 1, 5, 2, 6, 3, 7];
const FACES = [4, 5, 6, 4, 6, 7, 0, 1, 5, 0, 5, 4, 1, 2, 6, 1, 6, 5, 2, 3, 7, 2, 7, 6, 3, 0, 4, 3, 4, 7];

export function decodePoints(text: string): Float32Array {
  const bytes = Uint8Array.from(atob(text), (sign) => sign.charCodeAt(0));
  const view = new DataView(bytes.buffer);
  return Float32Array.from({ length: bytes.length >> 1 }, (_, n) => view.getInt16(2 * n, true) / 100);
}

function cornersOf([x, y, z, length, width, height, yaw]: Box): number[][] {
  const [c, s] = [Math.cos(yaw), Math.sin(yaw)];
  return [-1, 1].flatMap((up) =>
    [[1, 1], [-1, 1], [-1, -1], [1, -1]].map(([ahead, left]) => {
      const [u, v] = [(ahead * length) / 2, (left * width) / 2];
      return [x + c * u - s * v, y + s * u + c * v, z + (up * height) / 2];
    }),
  );
}

function drawBoxes(boxes: Box[], colour: string): Group {
  const group = new Group();
  const corners = boxes.map(cornersOf);
  const geometry = (order: number[], also: (box: Box) => number[]) => {
    const at = corners.flatMap((each, n) => [...order.flatMap((k) => each[k]), ...also(boxes[n])]);
    return new BufferGeometry().setAttribute("position", new BufferAttribute(new Float32Array(at), 3));
  };
  const heading = ([x, y, z, length, , , yaw]: Box) => {
    const [c, s] = [Math.cos(yaw), Math.sin(yaw)];
    return [x + (c * length) / 2, y + (s * length) / 2, z, x + c * (length / 2 + 1), y + s * (length / 2 + 1), z];
  };
  group.add(new LineSegments(geometry(EDGES, heading), new LineBasicMaterial({ color: colour })));
  group.add(new Mesh(geometry(FACES, () => []), new MeshBasicMaterial({ color: colour, transparent: true, opacity: 0.28, depthWrite: false, side: 2 })));
  return group;
}

/** An arrow that comes down on a place. */
function drawMark([x, y, z]: [number, number, number], ground: number, colour: string): Group {
  const [tip, top] = [z + 1.2, Math.max(z, ground) + 5];
  const head = [[0.6, 0], [-0.3, 0.52], [-0.3, -0.52]].map(([u, v]) => [x + u, y + v, tip + 1.4]);
  const faces = [0, 1, 2].flatMap((n) => [x, y, tip, ...head[n], ...head[(n + 1) % 3]]);
  const group = new Group();
  const shape = (at: number[]) => new BufferGeometry().setAttribute("position", new BufferAttribute(new Float32Array(at), 3));
  group.add(new Mesh(shape(faces), new MeshBasicMaterial({ color: colour, side: 2 })));
  group.add(new LineSegments(shape([x, y, tip + 1.4, x, y, top]), new LineBasicMaterial({ color: colour })));
  return group;
}

export class SweepScene {
  private readonly stage: Stage;
  private readonly sides: Scene[] = [];
  private readonly apart: Color;

  /** Draw both sides of a sweep in an element, side by side or, where it is narrow, one above the other. */
  constructor(host: HTMLElement, data: SweepData) {
    const told = tellSweep(data);
    this.stage = new Stage(host, `A sweep in three dimensions. ${told[0]}; ${told[1]}. Arrows turn it, plus and minus go nearer and away`, (stage, width, height) => this.paint(stage, width, height));
    this.apart = new Color(colourOf(host, "page", "#ffffff"));
    const colours = { found: colourOf(host, "seen", "#0072b2"), missed: colourOf(host, "miss", "#e0872b"), false: colourOf(host, "false", "#c4461f") };
    const points = this.cloud(host, data);
    for (const side of [data.before, data.after]) {
      const scene = new Scene();
      scene.background = this.stage.scene.background;
      scene.add(points.clone());
      scene.add(drawBoxes(data.targets.filter((_, n) => !side.found[n]), colours.missed));
      scene.add(drawBoxes(side.boxes.filter((_, n) => side.hit[n]), colours.found));
      scene.add(drawBoxes(side.boxes.filter((_, n) => !side.hit[n]), colours.false));
      if (data.mark) scene.add(drawMark(data.mark, data.ground, colourOf(host, "ink", "#1d2125")));
      this.sides.push(scene);
    }
    if (data.mark) {
      const [x, y] = data.mark;
      this.stage.look([x, y, data.ground], 34, 0.6, Math.atan2(y, x));
      return;
    }
    const middle = data.targets.length ? data.targets.reduce((sum, box) => sum + box[0], 0) / data.targets.length : 15;
    this.stage.look([Math.min(Math.max(middle, 8), 30), 0, data.ground], 52, 0.55, 0);
  }

  /** Leave the wheel to the page that scrolls, until the picture has the focus. */
  shareWheel() {
    const { controls, renderer } = this.stage;
    controls.enableZoom = false;
    renderer.domElement.addEventListener("focus", () => (controls.enableZoom = true));
    renderer.domElement.addEventListener("blur", () => (controls.enableZoom = false));
  }

  dispose() {
    this.stage.dispose();
  }

  private cloud(host: Element, data: SweepData): Points {
    const at = decodePoints(data.points);
    const [high, low] = [new Color(colourOf(host, "point", "#5d646b")), new Color(colourOf(host, "ground", "#b9bdc1"))];
    const colours = new Float32Array(at.length);
    for (let n = 0; n < at.length; n += 3) (at[n + 2] < data.ground + LOW_M ? low : high).toArray(colours, n);
    const shape = new BufferGeometry();
    shape.setAttribute("position", new BufferAttribute(at, 3));
    shape.setAttribute("color", new BufferAttribute(colours, 3));
    return new Points(shape, new PointsMaterial({ size: 1.6, sizeAttenuation: false, vertexColors: true }));
  }

  private paint({ renderer, camera }: Stage, width: number, height: number) {
    const narrow = width < 620;
    const [w, h] = narrow ? [width, height / 2] : [width / 2, height];
    camera.aspect = w / h;
    camera.updateProjectionMatrix();
    renderer.setScissorTest(false);
    renderer.setClearColor(this.apart);
    renderer.clear();
    renderer.setScissorTest(true);
    this.sides.forEach((scene, n) => {
      const gap = n ? 2 : 0; // between the sides
      const frame: [number, number, number, number] = narrow ? [0, (1 - n) * (h + 1), w, h - 1] : [n * w + gap, 0, w - gap, h];
      renderer.setViewport(...frame);
      renderer.setScissor(...frame);
      renderer.render(scene, camera);
    });
  }
}

/** Return what is found, missed and false, before and after, in words. */
export function tellSweep(data: SweepData): [string, string] {
  const tell = ({ title, hit, found }: Detections) => `${title}: ${found.filter(Boolean).length} found, ${found.filter((each) => !each).length} missed, ${hit.filter((each) => !each).length} false`;
  return [tell(data.before), tell(data.after)];
}
