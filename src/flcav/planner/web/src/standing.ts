/** What the map above and the one in three dimensions share: where a sensor comes to stand, by pointer and by keys. */
import { useLayoutEffect } from "preact/hooks";
import type { RefObject } from "preact";
import type { Kind, Look, NewPole, Point, Pole, Stand, Workspace } from "./types";

export const SNAP_M = 8;
export const MOUNT_M = 6; // of a place of one's own, above the ground

export type MapProps = {
  space: Workspace;
  stands: Stand[];
  kinds: Kind[];
  looks: Map<number, Look>;
  covered: Set<number>;
  shown: boolean[];
  kind: number;
  sight: boolean;
  onlyPoles: boolean;
  news: NewPole[];
  moving: boolean;
  carried: number | null; // the kind of sensor that is dragged from the panel
  onCarried: () => void;
  onDrag: (stand: Stand | null) => void; // while it is dragged; null: it was dropped nowhere
  onPut: (stand: Stand, fresh: boolean) => void;
  onToggle: (pole: number) => void;
  onRemove: (stand: Stand) => void;
  onRange: (kind: number, by: number) => void;
  selected: number | null;
  onSelect: (id: number | null) => void;
  held: number | null; // row of the error of which is told until another is chosen
  onHold: (row: number | null) => void;
  onSweep: (row: number) => void; // show the sweep in which an error was made
};

export function placeOf(stand: Stand, poles: Pole[]): Point {
  return stand.pole === null ? [stand.x, stand.y] : [poles[stand.pole].at[0], poles[stand.pole].at[1]];
}

/** The stand at a place: on the nearest pole within SNAP_M, or in a live planner there. */
export function settleAt(at: Point, stand: Stand, { space, stands, onlyPoles }: MapProps): Stand | null {
  let near: number | null = null;
  let least = onlyPoles ? Infinity : SNAP_M;
  space.poles.forEach((pole, number) => {
    const far = Math.hypot(pole.at[0] - at[0], pole.at[1] - at[1]);
    const taken = stands.some((each) => each.pole === number && each.id !== stand.id);
    if (far <= least && !taken) [near, least] = [number, far];
  });
  if (near === null && onlyPoles) return null;
  return { ...stand, pole: near, x: Math.round(at[0] * 10) / 10, y: Math.round(at[1] * 10) / 10 };
}

/** Keys of a sensor: Enter removes it, arrows move it, brackets change its range. */
export function pressKey(event: KeyboardEvent, stand: Stand, props: MapProps) {
  const step = event.shiftKey ? 10 : 1;
  const by = { ArrowLeft: [-step, 0], ArrowRight: [step, 0], ArrowUp: [0, step], ArrowDown: [0, -step] }[event.key];
  if (event.key === "Enter" || event.key === "Delete" || event.key === "Backspace") props.onRemove(stand);
  else if (event.key === "[" || event.key === "]") props.onRange(stand.kind, event.key === "]" ? step : -step);
  else if (by && !props.onlyPoles) {
    const [x, y] = placeOf(stand, props.space.poles);
    props.onPut({ ...stand, pole: null, x: Math.round((x + by[0]) * 10) / 10, y: Math.round((y + by[1]) * 10) / 10 }, false);
  } else return;
  event.preventDefault();
  event.stopPropagation();
}

/** Let a sensor that comes from the panel be carried by the pointer wherever that is over the map. */
export function useCarried(props: MapProps, over: RefObject<Element>, toWorld: (event: PointerEvent) => Point | null) {
  useLayoutEffect(() => {
    if (props.carried === null) return;
    const stand: Stand = { id: 0, pole: null, x: 0, y: 0, kind: props.carried };
    const settle = (event: PointerEvent) => {
      const frame = over.current!.getBoundingClientRect();
      const inside = event.clientX >= frame.left && event.clientX <= frame.right && event.clientY >= frame.top && event.clientY <= frame.bottom;
      const at = inside ? toWorld(event) : null;
      return at && settleAt(at, stand, props);
    };
    const carry = (event: PointerEvent) => props.onDrag(settle(event));
    const drop = (event: PointerEvent) => {
      const put = settle(event);
      props.onCarried();
      if (put) props.onPut(put, true);
      else props.onDrag(null);
    };
    window.addEventListener("pointermove", carry);
    window.addEventListener("pointerup", drop, { once: true });
    return () => {
      window.removeEventListener("pointermove", carry);
      window.removeEventListener("pointerup", drop);
    };
  });
}
