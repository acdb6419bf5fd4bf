/** Errors on both maps: their signs, what is told of one, and how keys go from one to the next. */
import { memo } from "preact/compat";
import { placeOf, type MapProps } from "./standing";
import type { Look, Pole, Stand, Wrong } from "./types";

const NAMES: Record<string, string> = { miss: "missed", false_positive: "false positive", final_error: "final error", point: "point" };
export const wordOf = (kind: string) => NAMES[kind] ?? kind;
export const nameOf = (error: Wrong) => `${error.class ?? ""} ${wordOf(error.kind)}`.trim();

/** The distance of an error from its vehicle in words, and null for points, which no vehicle made. */
export function tellDistance(error: Wrong): string | null {
  if (!["miss", "false_positive", "final_error"].includes(error.kind)) return null;
  return error.distance_m == null ? "unknown" : `${error.distance_m.toFixed(0)} m`;
}

/** An error in one sentence, for readers of screens. */
export function tellError(error: Wrong, seen: boolean, opens: boolean): string {
  const far = tellDistance(error);
  const hidden = error.occlusion == null ? "" : `, ${Math.round(error.occlusion * 100)} % hidden`;
  const from = far === null ? "" : far === "unknown" ? ", at an unknown distance from the vehicle" : `, ${far} from the vehicle`;
  return `${nameOf(error)}${from}${hidden}, ${seen ? "covered" : "not covered"}${opens ? "; Enter shows its sweep" : ""}`;
}

export const hasSweep = (props: Pick<MapProps, "space">, error: Wrong) => !!props.space.sweeps && error.distance_m != null;

/** The row of the nearest shown error in the direction of an arrow, or the same row where there is none. */
function nextError(from: number, [dx, dy]: [number, number], errors: Wrong[], shown: boolean[]): number {
  let [best, least] = [from, Infinity];
  errors.forEach((error, row) => {
    const [x, y] = [error.at[0] - errors[from].at[0], error.at[1] - errors[from].at[1]];
    const [far, ahead] = [Math.hypot(x, y), x * dx + y * dy];
    if (shown[row] && row !== from && ahead > 0.5 * far && far < least) [best, least] = [row, far];
  });
  return best;
}

/** Keys of an error: arrows go to the next one, Enter and Space open its sweep, Escape closes what is told. */
export function pressErrorKey(event: KeyboardEvent, row: number, props: MapProps, focus: (row: number) => void) {
  const by = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] }[event.key] as [number, number] | undefined;
  const { errors } = props.space;
  if (by) focus(nextError(row, by, errors, props.shown));
  else if (event.key === "Enter" || event.key === " ") hasSweep(props, errors[row]) && props.onSweep(row);
  else if (event.key === "Escape") props.onHold(null);
  else return;
  event.preventDefault();
  event.stopPropagation();
}

type SignProps = {
  error: Wrong;
  row: number;
  seen: boolean;
  many: boolean;
  first: boolean; // whether Tab goes to it
  opens: boolean;
  px: (n: number) => number;
  onHover: (row: number | null) => void;
  onHold: (row: number | null) => void;
  onKey: (event: KeyboardEvent, row: number) => void;
};

export const Sign = memo(
  ({ error, row, seen, many, first, opens, px, onHover, onHold, onKey }: SignProps) => {
    const [x, y] = error.at;
    const r = px(many ? 2.6 : 4);
    const common = {
      id: `error-${row}`,
      class: `e ${error.kind}${seen ? " seen" : ""}`,
      role: "button" as const,
      tabindex: first ? 0 : -1,
      "aria-label": tellError(error, seen, opens),
      onPointerEnter: (event: PointerEvent) => event.pointerType === "mouse" && onHover(row),
      onPointerLeave: () => onHover(null),
      onFocus: () => onHold(row),
      onBlur: (event: FocusEvent) => !(event.relatedTarget as Element | null)?.closest(".tip") && onHold(null),
      onKeyDown: (event: KeyboardEvent) => onKey(event, row),
    };
    if (error.kind === "false_positive")
      return <path {...common} stroke-width={px(2)} d={`M${x - r} ${-y - r}l${2 * r} ${2 * r}m0 ${-2 * r}l${-2 * r} ${2 * r}`} />;
    if (error.kind === "final_error")
      return <path {...common} stroke-width={px(1)} d={`M${x} ${-y - r * 1.2}l${r * 1.15} ${r * 2.1}h${-r * 2.3}Z`} />;
    return <circle {...common} cx={x} cy={-y} r={r} stroke-width={px(1)} />;
  },
  (one, other) => one.seen === other.seen && one.error === other.error && one.first === other.first && one.opens === other.opens && one.px(1) === other.px(1),
);

type TipProps = MapProps & { row: number; stays: boolean; at: [number, number] };

/** What is told of an error beside it; while it is held, with what it opens. */
export function Tip({ row, stays, at, ...props }: TipProps) {
  const error = props.space.errors[row];
  const opens = hasSweep(props, error);
  return (
    <div class={`tip${stays ? " held" : ""}`} style={{ left: `${at[0]}px`, top: `${at[1]}px` }} onMouseDown={(event) => event.preventDefault()}>
      <Told error={error} row={row} stands={props.stands} poles={props.space.poles} looks={props.looks} />
      {opens && stays && <button type="button" class="primary" onClick={() => props.onSweep(row)}>Show its sweep</button>}
      {opens && !stays && <p class="note">Press it for its sweep.</p>}
      {!opens && props.space.sweeps && <p class="note">In which sweep it was made is unknown: the table has no distances.</p>}
      {stays && <button type="button" class="quiet shut" aria-label="Close what is told" onClick={() => props.onHold(null)}>×</button>}
    </div>
  );
}

function Told({ error, row, stands, poles, looks }: { error: Wrong; row: number; stands: Stand[]; poles: Pole[]; looks: Map<number, Look> }) {
  const by = stands.filter((each) => looks.get(each.id)?.covered.includes(row));
  const far = (stand: Stand) => {
    const [x, y] = placeOf(stand, poles);
    return Math.hypot(x - error.at[0], y - error.at[1]);
  };
  const near = [...stands].sort((one, other) => far(one) - far(other))[0];
  const distance = tellDistance(error);
  return (
    <>
      <b>{nameOf(error)}</b>
      <dl>
        {distance && <><dt>from the vehicle</dt><dd>{distance}</dd></>}
        {error.occlusion != null && <><dt>hidden from it</dt><dd>{Math.round(error.occlusion * 100)} %</dd></>}
        {error.returns != null && <><dt>LiDAR returns</dt><dd>{error.returns}</dd></>}
        {near && <><dt>nearest sensor</dt><dd>{far(near).toFixed(0)} m</dd></>}
        <dt>seen by</dt><dd>{by.length ? by.map((each) => (each.pole === null ? "own place" : `pole ${poles[each.pole].id}`)).join(", ") : "no sensor"}</dd>
        {error.scene && <><dt>sweep of</dt><dd>{error.scene}{error.track ? `, ${error.track}` : ""}</dd></>}
        {error.weight !== 1 && <><dt>weight</dt><dd>{error.weight}</dd></>}
      </dl>
    </>
  );
}

/** Where a tip stands beside a place on the map [px], within a frame of a size. */
export const besides = ([x, y]: [number, number], [width, height]: [number, number]): [number, number] => [
  Math.max(Math.min(x, width - 272), -8),
  Math.max(y > height - 230 ? y - 230 : y, -8),
];
