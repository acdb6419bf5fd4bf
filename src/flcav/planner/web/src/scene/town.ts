/** A town in three dimensions: ground with streets, houses, trees, poles, errors, and what sensors see. */
import {
  BoxGeometry, BufferAttribute, BufferGeometry, CanvasTexture, Color, ConeGeometry, CylinderGeometry, InstancedMesh, Matrix4, Mesh,
  MeshBasicMaterial, MeshLambertMaterial, PlaneGeometry, Raycaster, SphereGeometry, SRGBColorSpace, Vector2, Vector3, type Object3D,
} from "three";
import type { Point, TownMap } from "../types";
import { colourOf, Stage } from "./stage";

const BASE_PX = 2048; // longer side of the drawn ground
const AREA_PX = 1024; // longer side of the visible areas on it
const CELLS = 96; // of the ground's longer side, where it is not level

export type Sensor = { at: [number, number, number]; colour: string; area: string; range: number; chosen: boolean };
export type Mark = { at: [number, number, number]; colour: string; cross: boolean };

/** Return the height of the ground [m] at a place, from a map's grid of heights; 0 where it is level. */
export function groundOf(map: TownMap, x: number, y: number): number {
  if (!map.relief) return 0;
  const [x0, y0, x1, y1] = map.bounds;
  const { columns, rows, z } = map.relief;
  const within = (value: number, most: number) => Math.min(Math.max(value, 0), most - 1.001);
  const [u, v] = [within(((x - x0) / (x1 - x0)) * (columns - 1), columns), within(((y - y0) / (y1 - y0)) * (rows - 1), rows)];
  const [i, j] = [Math.floor(u), Math.floor(v)];
  const at = (column: number, row: number) => z[row * columns + column];
  const along = (row: number) => at(i, row) + (at(i + 1, row) - at(i, row)) * (u - i);
  return along(j) + (along(j + 1) - along(j)) * (v - j);
}

export class TownScene {
  private readonly stage: Stage;
  private readonly areas = document.createElement("canvas");
  private readonly texture: CanvasTexture;
  private readonly ground: Mesh;
  private readonly map: TownMap;
  private errors: InstancedMesh[] = [];
  private rows: number[][] = [];
  private sensors: Object3D[] = [];

  constructor(host: HTMLElement, map: TownMap, poles: [number, number, number][]) {
    this.map = map;
    this.stage = new Stage(host, `${map.name} in three dimensions; arrows turn it, plus and minus go nearer and away`, (stage) => stage.renderer.render(stage.scene, stage.camera));
    const { scene } = this.stage;
    const [x0, y0, x1, y1] = map.bounds;
    const base = this.canvas(BASE_PX);
    this.drawBase(base);
    const ground = new CanvasTexture(base);
    ground.colorSpace = SRGBColorSpace;
    ground.anisotropy = this.stage.renderer.capabilities.getMaxAnisotropy();
    const plate = this.plate();
    this.ground = new Mesh(plate, new MeshBasicMaterial({ map: ground }));
    this.areas = this.canvas(AREA_PX);
    this.texture = new CanvasTexture(this.areas);
    this.texture.colorSpace = SRGBColorSpace;
    const over = new Mesh(plate, new MeshBasicMaterial({ map: this.texture, transparent: true, depthWrite: false, polygonOffset: true, polygonOffsetFactor: -2, polygonOffsetUnits: -2 }));
    scene.add(this.ground, over, this.houses());
    this.addTrees();
    this.addPoles(poles);
    const wide = Math.max(x1 - x0, y1 - y0);
    this.stage.camera.far = 20 * wide;
    this.stage.controls.maxDistance = 4 * wide;
    const far = (1.2 * wide) / Math.min(1, host.clientWidth / host.clientHeight || 1);
    this.stage.look([(x0 + x1) / 2, (y0 + y1) / 2, groundOf(map, (x0 + x1) / 2, (y0 + y1) / 2)], far, 0.8, Math.PI / 2);
  }

  set onMove(then: () => void) {
    this.stage.onMove = then;
  }

  /** Show sensors with what they see, and errors in their colours. */
  show(sensors: Sensor[], errors: Mark[]) {
    const { scene } = this.stage;
    scene.remove(...this.sensors, ...this.errors);
    for (const each of [...this.sensors, ...this.errors] as Mesh[]) each.geometry.dispose();
    this.sensors = sensors.map(({ at, colour, chosen }) => {
      const foot = groundOf(this.map, at[0], at[1]);
      const [thick, tall] = [chosen ? 0.8 : 0.55, Math.max(at[2] - foot, 1)];
      const mast = new Mesh(new CylinderGeometry(thick, thick, tall, 12).rotateX(Math.PI / 2), new MeshLambertMaterial({ color: colour }));
      mast.position.set(at[0], at[1], foot + tall / 2);
      return mast;
    });
    const size = Math.max(0.9, Math.hypot(this.map.bounds[2] - this.map.bounds[0], this.map.bounds[3] - this.map.bounds[1]) / 300);
    const kinds: [boolean, BufferGeometry][] = [[false, new SphereGeometry(size, 12, 8)], [true, new BoxGeometry(1.5 * size, 1.5 * size, 1.5 * size)]];
    this.rows = kinds.map(([cross]) => errors.flatMap((each, row) => (each.cross === cross && each.colour ? [row] : [])));
    this.errors = kinds.map(([, shape], which) => {
      const mesh = new InstancedMesh(shape, new MeshLambertMaterial(), this.rows[which].length);
      const [matrix, tint] = [new Matrix4(), new Color()];
      this.rows[which].forEach((row, n) => {
        const { at, colour } = errors[row];
        mesh.setMatrixAt(n, matrix.setPosition(at[0], at[1], Math.max(at[2], groundOf(this.map, at[0], at[1]) + size)));
        mesh.setColorAt(n, tint.set(colour));
      });
      return mesh;
    });
    scene.add(...this.sensors, ...this.errors);
    this.drawAreas(sensors);
    this.stage.draw();
  }

  /** Return the pixel of a place [m], or null behind the camera. */
  project([x, y, z]: [number, number, number]): Point | null {
    const { camera, renderer } = this.stage;
    const at = new Vector3(x, y, z).project(camera);
    if (at.z > 1) return null;
    const { clientWidth, clientHeight } = renderer.domElement;
    return [((at.x + 1) / 2) * clientWidth, ((1 - at.y) / 2) * clientHeight];
  }

  /** Return the place on the ground [m] under a pixel of the window, or null beside the ground. */
  groundAt(event: { clientX: number; clientY: number }): Point | null {
    const hit = this.ray(event).intersectObject(this.ground)[0];
    return hit ? [hit.point.x, hit.point.y] : null;
  }

  /** Return the row of the error under a pixel of the window, or null. */
  errorAt(event: { clientX: number; clientY: number }): number | null {
    const [hit] = this.ray(event).intersectObjects(this.errors);
    return hit?.instanceId === undefined ? null : this.rows[this.errors.indexOf(hit.object as InstancedMesh)][hit.instanceId];
  }

  /** Return the picture that is shown, as PNG. */
  picture(then: (png: Blob | null) => void) {
    this.stage.renderer.domElement.toBlob(then, "image/png");
  }

  dispose() {
    this.stage.dispose();
  }

  private ray({ clientX, clientY }: { clientX: number; clientY: number }): Raycaster {
    const frame = this.stage.renderer.domElement.getBoundingClientRect();
    const ray = new Raycaster();
    const at = new Vector2(((clientX - frame.left) / frame.width) * 2 - 1, 1 - ((clientY - frame.top) / frame.height) * 2);
    ray.setFromCamera(at, this.stage.camera);
    return ray;
  }

  private canvas(side: number): HTMLCanvasElement {
    const [x0, y0, x1, y1] = this.map.bounds;
    const canvas = document.createElement("canvas");
    const scale = side / Math.max(x1 - x0, y1 - y0);
    [canvas.width, canvas.height] = [Math.round((x1 - x0) * scale), Math.round((y1 - y0) * scale)];
    return canvas;
  }

  /** Return the drawing context of a canvas in metres of the world, y up. */
  private inMetres(canvas: HTMLCanvasElement): CanvasRenderingContext2D {
    const [x0, y0, x1, y1] = this.map.bounds;
    const draw = canvas.getContext("2d")!;
    const [a, d] = [canvas.width / (x1 - x0), canvas.height / (y1 - y0)];
    draw.setTransform(1, 0, 0, 1, 0, 0);
    draw.clearRect(0, 0, canvas.width, canvas.height);
    draw.setTransform(a, 0, 0, -d, -x0 * a, y1 * d);
    return draw;
  }

  private drawBase(canvas: HTMLCanvasElement) {
    const { map } = this;
    const draw = this.inMetres(canvas);
    const host = this.stage.renderer.domElement;
    const [x0, y0, x1, y1] = map.bounds;
    draw.fillStyle = colourOf(host, "land", "#eeebe4");
    draw.fillRect(x0, y0, x1 - x0, y1 - y0);
    for (const [polygons, name, otherwise] of [[map.sidewalks, "walk", "#f7f5f0"], [map.roads, "road", "#ffffff"]] as const) {
      draw.fillStyle = colourOf(host, name, otherwise);
      for (const polygon of polygons) draw.fill(new Path2D(`M${polygon.map((point) => point.join(" ")).join("L")}Z`));
    }
  }

  private drawAreas(sensors: Sensor[]) {
    const draw = this.inMetres(this.areas);
    for (const { at, colour, area, range, chosen } of sensors) {
      const shape = area ? new Path2D(area) : new Path2D();
      if (!area) shape.arc(at[0], at[1], range, 0, 2 * Math.PI);
      draw.globalAlpha = chosen ? 0.42 : 0.3;
      draw.fillStyle = draw.strokeStyle = colour;
      draw.fill(shape, "evenodd");
      draw.globalAlpha = 0.9;
      draw.lineWidth = 0.6;
      draw.stroke(shape);
    }
    this.texture.needsUpdate = true;
  }

  private plate(): PlaneGeometry {
    const { bounds: [x0, y0, x1, y1], relief } = this.map;
    const cells = relief ? CELLS : 1;
    const plate = new PlaneGeometry(x1 - x0, y1 - y0, cells, cells).translate((x0 + x1) / 2, (y0 + y1) / 2, 0);
    const at = plate.attributes.position;
    if (relief) for (let n = 0; n < at.count; n++) at.setZ(n, groundOf(this.map, at.getX(n), at.getY(n)));
    return plate;
  }

  private houses(): Mesh {
    const corners: number[] = [];
    this.map.houses.forEach((outline, n) => {
      const foot = Math.min(...outline.map(([x, y]) => groundOf(this.map, x, y)));
      const top = Math.max(...outline.map(([x, y]) => groundOf(this.map, x, y))) + this.map.heights[n];
      const quad = (a: number[], b: number[], c: number[], d: number[]) => corners.push(...a, ...b, ...c, ...a, ...c, ...d);
      const turned = outline.reduce((sum, [x, y], k) => sum + x * outline[(k + 1) % 4][1] - y * outline[(k + 1) % 4][0], 0) < 0;
      const ring = turned ? [...outline].reverse() : outline;
      ring.forEach(([x, y], k) => {
        const [u, v] = ring[(k + 1) % ring.length];
        quad([x, y, foot], [u, v, foot], [u, v, top], [x, y, top]);
      });
      const [a, b, c, d] = ring.map(([x, y]) => [x, y, top]);
      quad(a, b, c, d);
    });
    const walls = new BufferGeometry();
    walls.setAttribute("position", new BufferAttribute(new Float32Array(corners), 3));
    walls.computeVertexNormals();
    return new Mesh(walls, new MeshLambertMaterial({ color: colourOf(this.stage.renderer.domElement, "house", "#d6cfc2") }));
  }

  private addTrees() {
    const { trees } = this.map;
    const crowns = new InstancedMesh(new SphereGeometry(1, 9, 7), new MeshLambertMaterial({ color: colourOf(this.stage.renderer.domElement, "crown", "#a9c49e") }), trees.length);
    const trunks = new InstancedMesh(new CylinderGeometry(0.2, 0.25, 1, 6).rotateX(Math.PI / 2).translate(0, 0, 0.5), new MeshLambertMaterial({ color: "#8a7a66" }), trees.length);
    const matrix = new Matrix4();
    trees.forEach(([x, y, radius, height], n) => {
      const [foot, tall] = [groundOf(this.map, x, y), Math.max(height / 2 - 0.5, radius)];
      crowns.setMatrixAt(n, matrix.makeScale(radius, radius, tall * 0.8).setPosition(x, y, foot + height - tall * 0.8));
      trunks.setMatrixAt(n, matrix.makeScale(1, 1, height / 2).setPosition(x, y, foot));
    });
    this.stage.scene.add(crowns, trunks);
  }

  private addPoles(poles: [number, number, number][]) {
    const masts = new InstancedMesh(new CylinderGeometry(0.18, 0.25, 1, 8).rotateX(Math.PI / 2).translate(0, 0, 0.5), new MeshLambertMaterial({ color: "#6d747b" }), poles.length);
    const tops = new InstancedMesh(new ConeGeometry(0.6, 0.8, 8).rotateX(Math.PI / 2), new MeshLambertMaterial({ color: "#6d747b" }), poles.length);
    const matrix = new Matrix4();
    poles.forEach(([x, y, z], n) => {
      const foot = groundOf(this.map, x, y);
      masts.setMatrixAt(n, matrix.makeScale(1, 1, Math.max(z - foot, 1)).setPosition(x, y, foot));
      tops.setMatrixAt(n, matrix.makeTranslation(x, y, z));
    });
    this.stage.scene.add(masts, tops);
  }
}
