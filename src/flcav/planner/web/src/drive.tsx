/** A region of a run as it is played: its vehicles drive, misses pop up, and messages go to the edge server and the cloud. */
import { useEffect, useMemo, useRef } from "preact/hooks";
import type { RefObject } from "preact";
import { lengthOf, placeUsers } from "./motion";
import type { Drive, Moment, Point, RegionDrive } from "./types";

export type Clock = { at: number; part: number }; // number of the moment, and how much of it has passed, 0 to 1

const POP_S = 0.5; // that a miss pops up
const EDGE_M = 12; // shown around the streets
const path = (points: Point[]) => `M${points.map(([x, y]) => `${x} ${y}`).join("L")}Z`;

/** The drive that is played at a time [s] of a row of them, the time in it, and its number. */
function findDrive(drives: Drive[], time: number): { drive: Drive; number: number; time: number } | null {
  let left = time;
  for (const [number, drive] of drives.entries()) {
    if (left <= lengthOf(drive) || number === drives.length - 1) return { drive, number, time: Math.min(left, lengthOf(drive)) };
    left -= lengthOf(drive);
  }
  return null;
}

const spanOf = (drives: Drive[]) => drives.reduce((sum, each) => sum + lengthOf(each), 0);

/** What is told below the map at a moment. */
export function tellMoment(shown: RegionDrive, region: string, moment: Moment): string {
  if (moment.stage === "pretrain") return `Vehicles drive with the pretrained network; ${shown.errors.length} of the ${shown.all} errors that it makes here pop up where they were registered.`;
  const names = [...new Set(moment.servers.filter((each) => each.server === region).flatMap((each) => each.clients))];
  const edge = names.length ? `The edge server sends the model to ${names.join(", ")}, and gets their updates back over the wireless link.` : "No vehicle of this region takes part.";
  return moment.servers.some((each) => each.server === "cloud") ? `${edge} It exchanges models with the cloud over the wireline.` : edge;
}

export function DriveView({ shown, region, moments, clock, playing }: { shown: RegionDrive; region: string; moments: Moment[]; clock: RefObject<Clock>; playing: boolean }) {
  const canvas = useRef<HTMLCanvasElement>(null);
  const base = useRef<HTMLCanvasElement | null>(null);
  const offsets = useMemo(() => {
    let sum = 0;
    return shown.registry.map((drive) => (sum += lengthOf(drive)) - lengthOf(drive));
  }, [shown]);
  const rounds = useMemo(() => moments.map((each, n) => (each.stage === "pretrain" ? -1 : n - moments.filter((one) => one.stage === "pretrain").length)), [moments]);
  const extent = useMemo(() => {
    const points = shown.map.roads.flat();
    const [x, y] = [points.map((each) => each[0]), points.map((each) => each[1])];
    return [Math.min(...x) - EDGE_M, Math.min(...y) - EDGE_M, Math.max(...x) + EDGE_M, Math.max(...y) + EDGE_M];
  }, [shown]);
  const at = clock.current!.at;

  const draw = () => {
    const element = canvas.current;
    if (!element) return;
    const ratio = Math.min(devicePixelRatio, 2);
    const [width, height] = [element.clientWidth * ratio, element.clientHeight * ratio];
    if (!width || !height) return;
    const [x0, y0, x1, y1] = extent;
    const scale = Math.min(width / (x1 - x0), height / (y1 - y0));
    const [left, top] = [(width - (x1 - x0) * scale) / 2 - x0 * scale, (height - (y1 - y0) * scale) / 2 + y1 * scale];
    const colour = (name: string) => getComputedStyle(element).getPropertyValue(`--${name}`).trim();
    if (element.width !== Math.round(width) || element.height !== Math.round(height) || !base.current) {
      [element.width, element.height] = [Math.round(width), Math.round(height)];
      base.current = document.createElement("canvas");
      [base.current.width, base.current.height] = [element.width, element.height];
      const ground = base.current.getContext("2d")!;
      ground.fillStyle = colour("land");
      ground.fillRect(0, 0, width, height);
      ground.setTransform(scale, 0, 0, -scale, left, top);
      for (const [polygons, name] of [[shown.map.sidewalks, "walk"], [shown.map.roads, "road"], [shown.map.houses, "house"]] as const) {
        ground.fillStyle = colour(name);
        ground.fill(new Path2D(polygons.map(path).join("")));
      }
    }
    const pen = element.getContext("2d")!;
    pen.setTransform(1, 0, 0, 1, 0, 0);
    pen.drawImage(base.current, 0, 0);
    const px = ([x, y]: Point): Point => [left + x * scale, top - y * scale];
    const dot = ([x, y]: Point, r: number, fill: string) => {
      pen.fillStyle = fill;
      pen.beginPath();
      pen.arc(x, y, r, 0, 2 * Math.PI);
      pen.fill();
    };
    const unit = 4 * ratio;
    const { at: n } = clock.current!;
    const part = matchMedia("(prefers-reduced-motion: reduce)").matches ? 1 : clock.current!.part;
    const moment = moments[n];
    const learning = moment.stage !== "pretrain";
    const drives = learning && shown.edge.length ? shown.edge : shown.registry;
    const span = spanOf(drives);
    const stage = moments.length - moments.filter((each) => each.stage === "pretrain").length;
    const time = learning ? (span * (rounds[n] + part)) / Math.max(stage, 1) : span * part;
    const found = findDrive(drives, time);

    // The chosen poles with their range, and the errors that were registered up to now.
    shown.poles.forEach((pole) => {
      const [x, y] = px([pole[0], pole[1]]);
      pen.strokeStyle = colour("k0");
      pen.setLineDash([2 * ratio, 4 * ratio]);
      pen.beginPath();
      pen.arc(x, y, shown.range_m * scale, 0, 2 * Math.PI);
      pen.stroke();
      pen.setLineDash([]);
    });
    for (const error of shown.errors) {
      const age = learning ? Infinity : time - offsets[error.scene] - error.when;
      if (age < 0) continue;
      const where = px(error.at);
      const tint = colour(error.kind === "false_positive" ? "false" : "miss");
      if (age < POP_S) {
        pen.globalAlpha = 1 - age / POP_S;
        dot(where, unit * (1 + (4 * age) / POP_S), tint);
      }
      pen.globalAlpha = learning ? 0.55 : 1;
      dot(where, 0.8 * unit, tint);
      pen.globalAlpha = 1;
    }

    // Road users: those that learn in colour.
    const where = new Map<string, Point>();
    for (const { name, walks, size, pose } of found ? placeUsers(found.drive, found.time) : []) {
      const [x, y] = px([pose[0], pose[1]]);
      const own = name.startsWith("cav");
      if (own) where.set(name, [x, y]);
      if (walks) {
        dot([x, y], 1.1 * ratio, colour("muted"));
        continue;
      }
      const grown = own ? 1.6 : 1.1;
      const [length, width] = [Math.max(size[0] * scale * grown, (own ? 13 : 5) * ratio), Math.max(size[1] * scale * grown, (own ? 7 : 3) * ratio)];
      pen.save();
      pen.translate(x, y);
      pen.rotate(-pose[2]);
      pen.globalAlpha = own ? 1 : 0.6;
      pen.fillStyle = colour(own ? "k1" : "muted");
      pen.strokeStyle = colour("page");
      pen.lineWidth = ratio;
      pen.beginPath();
      pen.roundRect(-length / 2, -width / 2, length, width, width / 4);
      pen.fill();
      if (own) pen.stroke();
      pen.restore(); // with its opacity
    }

    // Messages: the model goes down in the first half of a round, updates go up in the second.
    const server: Point = shown.poles.length ? px([shown.poles[0][0], shown.poles[0][1]]) : [width / 2, height / 2];
    const cloud: Point = [width - 34 * ratio, 20 * ratio];
    const label = (text: string, [x, y]: Point, fill: string) => {
      pen.font = `600 ${11 * ratio}px system-ui, sans-serif`;
      const wide = pen.measureText(text).width + 12 * ratio;
      pen.fillStyle = fill;
      pen.beginPath();
      pen.roundRect(x - wide / 2, y - 9 * ratio, wide, 18 * ratio, 9 * ratio);
      pen.fill();
      pen.fillStyle = colour("page");
      pen.textAlign = "center";
      pen.textBaseline = "middle";
      pen.fillText(text, x, y + ratio / 2);
    };
    const pulse = (from: Point, to: Point, late: number, tint: string) => {
      const down = part < 0.5;
      const gone = Math.min(Math.max((down ? part : part - 0.5) * 2.6 - late, 0), 1);
      const [a, b] = down ? [from, to] : [to, from];
      pen.strokeStyle = tint;
      pen.globalAlpha = 0.25;
      pen.lineWidth = ratio;
      pen.beginPath();
      pen.moveTo(...from);
      pen.lineTo(...to);
      pen.stroke();
      pen.globalAlpha = 1;
      if (gone <= 0 || gone >= 1) return;
      const middle: Point = [a[0] + (b[0] - a[0]) * gone, a[1] + (b[1] - a[1]) * gone];
      dot(middle, 1.7 * unit, colour("page"));
      dot(middle, 1.3 * unit, tint);
    };
    const linked = moment.servers.some((each) => each.server === "cloud" && each.clients.includes(region));
    const clients = [...new Set(moment.servers.filter((each) => each.server === region).flatMap((each) => each.clients))];
    if (linked) pulse(cloud, server, 0, colour("k2"));
    clients.forEach((name, order) => where.has(name) && pulse(server, where.get(name)!, 0.25 * (order / Math.max(clients.length, 1)), colour("k0")));
    if (shown.poles.length || learning) label("edge", server, colour("k0"));
    if (linked) label("cloud", cloud, colour("k2"));
  };

  useEffect(() => {
    let asked = 0;
    const turn = () => {
      draw();
      asked = playing ? requestAnimationFrame(turn) : 0;
    };
    turn();
    const again = () => [(base.current = null), draw()];
    const watch = new ResizeObserver(again);
    watch.observe(canvas.current!);
    const dark = matchMedia("(prefers-color-scheme: dark)");
    dark.addEventListener("change", again);
    return () => [cancelAnimationFrame(asked), watch.disconnect(), dark.removeEventListener("change", again)] as unknown as void;
  }, [shown, playing, at, region]);

  return <canvas ref={canvas} class="drive" role="img" aria-label={`${region}: ${tellMoment(shown, region, moments[at])}`} />;
}
