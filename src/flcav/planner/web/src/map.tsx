/** The map: a town in metres, its errors, poles and sensors, with pointer and keyboard. */
import { memo } from "preact/compat";
import { useEffect, useLayoutEffect, useMemo, useRef, useState } from "preact/hooks";
import { placeOf, pressKey, settleAt, useCarried, type MapProps } from "./standing";
import type { Look, Point, Pole, Stand, TownMap, Wrong } from "./types";

const path = (points: Point[]) => `M${points.map(([x, y]) => `${x} ${y}`).join("L")}Z`;

const Ground = memo(({ map }: { map: TownMap }) => (
  <g class="ground" aria-hidden="true">
    <path class="walk" d={map.sidewalks.map(path).join("")} />
    <path class="road" d={map.roads.map(path).join("")} />
    <g class="tree">{map.trees.map(([x, y, r]) => <circle cx={x} cy={y} r={r} />)}</g>
    <path class="house" d={map.houses.map(path).join("")} />
  </g>
));

type Box = { x: number; y: number; w: number; h: number };
type Drag = { stand: Stand; fresh: boolean; moved: boolean };

export function TownView(props: MapProps) {
  const { space, stands, kinds, looks, covered, shown } = props;
  const { map, poles, errors } = space;
  const svg = useRef<SVGSVGElement>(null);
  const [size, setSize] = useState<[number, number]>([800, 600]);
  const whole = useMemo((): Box => {
    const [x0, y0, x1, y1] = map.bounds;
    return { x: x0, y: -y1, w: x1 - x0, h: y1 - y0 };
  }, [map]);
  const [box, setBox] = useState<Box>(whole);
  const [hover, setHover] = useState<{ error: number; x: number; y: number } | null>(null);
  const drag = useRef<Drag | null>(null);
  const fingers = useRef(new Map<number, Point>());
  useEffect(() => setBox(whole), [whole]);
  useLayoutEffect(() => {
    const { width, height } = svg.current!.getBoundingClientRect();
    setSize([width, height]);
    const watch = new ResizeObserver(([entry]) => setSize([entry.contentRect.width, entry.contentRect.height]));
    watch.observe(svg.current!);
    return () => watch.disconnect();
  }, []);
  const scale = Math.max(box.w / size[0], box.h / size[1]); // metres a pixel
  const px = (pixels: number) => pixels * scale;

  const toWorld = (event: { clientX: number; clientY: number }): Point => {
    const frame = svg.current!.getBoundingClientRect();
    const x = box.x + box.w / 2 + (event.clientX - frame.left - frame.width / 2) * scale;
    const y = box.y + box.h / 2 + (event.clientY - frame.top - frame.height / 2) * scale;
    return [x, -y];
  };
  const zoom = (by: number, at?: Point) => {
    const [x, y] = at ?? [box.x + box.w / 2, -(box.y + box.h / 2)];
    const w = Math.min(Math.max(box.w * by, 30), whole.w * 2);
    const ratio = w / box.w;
    setBox({ x: x - (x - box.x) * ratio, y: -y - (-y - box.y) * ratio, w, h: box.h * ratio });
  };
  useEffect(() => {
    const element = svg.current;
    const turn = (event: WheelEvent) => {
      event.preventDefault();
      zoom(Math.exp(event.deltaY * 0.0015), toWorld(event));
    };
    element?.addEventListener("wheel", turn, { passive: false });
    return () => element?.removeEventListener("wheel", turn);
  });

  const settle = (at: Point, stand: Stand) => settleAt(at, stand, props);

  const pressed = (event: PointerEvent, stand?: Stand) => {
    if (event.button > 0) return;
    svg.current!.setPointerCapture(event.pointerId);
    fingers.current.set(event.pointerId, [event.clientX, event.clientY]);
    setHover(null);
    drag.current = stand && fingers.current.size === 1 ? { stand, fresh: false, moved: false } : null;
  };
  const moved = (event: PointerEvent) => {
    const before = fingers.current.get(event.pointerId);
    if (!before) return;
    const now: Point = [event.clientX, event.clientY];
    if (drag.current) {
      if (!drag.current.moved && Math.hypot(now[0] - before[0], now[1] - before[1]) < 4) return;
      const next = settle(toWorld(event), drag.current.stand);
      if (next) {
        drag.current = { ...drag.current, stand: next, moved: true };
        props.onDrag(next);
      }
      return;
    }
    const others = [...fingers.current].filter(([id]) => id !== event.pointerId);
    fingers.current.set(event.pointerId, now);
    if (others.length) {
      const far = (one: Point) => Math.hypot(one[0] - others[0][1][0], one[1] - others[0][1][1]);
      if (far(now) > 10) zoom(far(before) / far(now), toWorld({ clientX: now[0], clientY: now[1] }));
    } else setBox({ ...box, x: box.x - (now[0] - before[0]) * scale, y: box.y - (now[1] - before[1]) * scale });
  };
  const released = (event: PointerEvent) => {
    fingers.current.delete(event.pointerId);
    const done = drag.current;
    drag.current = null;
    if (!done) return;
    if (done.moved) props.onPut(done.stand, false);
    else props.onSelect(done.stand.id);
  };

  useCarried(props, svg, toWorld);
  const keyed = (event: KeyboardEvent, stand: Stand) => pressKey(event, stand, props);

  const occupied = new Set(stands.map((each) => each.pole));
  const told = hover && errors[hover.error];
  return (
    <div class="map" data-scale={scale}>
      <svg
        ref={svg}
        role="group"
        aria-label={`Map of ${map.name}`}
        viewBox={`${box.x} ${box.y} ${box.w} ${box.h}`}
        onPointerDown={(event) => pressed(event)}
        onPointerMove={moved}
        onPointerUp={released}
        onPointerCancel={released}
      >
        <g transform="scale(1,-1)">
          <Ground map={map} />
          {props.stands.map((stand) => {
            const look = looks.get(stand.id);
            const [x, y] = placeOf(stand, poles);
            const range = kinds[stand.kind]?.range_m ?? 0;
            const chosen = props.selected === stand.id;
            return (
              <g key={stand.id} class={`reach k${stand.kind % 6}${chosen ? " chosen" : ""}`} aria-hidden="true">
                <circle cx={x} cy={y} r={Math.sqrt(Math.max(range * range - 36, 0))} stroke-dasharray={`${px(2)} ${px(4)}`} class={props.sight ? "" : "full"} />
                {props.sight && look && <path d={look.area} fill-rule="evenodd" />}
              </g>
            );
          })}
        </g>
        <g class="names" aria-hidden="true">
          {map.streets.map(({ name, line }) => <StreetName name={name} line={line} px={px} />)}
        </g>
        <g class="errors" aria-hidden="true">
          {errors.map((error, row) =>
            shown[row] ? <Sign error={error} row={row} seen={covered.has(row)} px={px} onHover={setHover} many={errors.length > 400} /> : null,
          )}
        </g>
        {props.news.map((place, number) => (
          <g class="new" transform={`translate(${place.site.x} ${-place.site.y})`}>
            <circle r={px(12)} />
            <text font-size={px(11)} dy=".35em">+{Math.round(place.gain * 10) / 10}</text>
            <title>{`A new pole here: ${place.errors} more, place ${number + 1}`}</title>
          </g>
        ))}
        {poles.map((pole, number) =>
          occupied.has(number) ? null : (
            <g
              key={`p${number}`}
              id={`pole-${number}`}
              class="pole"
              role="button"
              tabindex={0}
              aria-label={`Pole ${pole.id}${pole.street ? `, ${pole.street}` : ""}: place ${kinds[props.kind]?.name ?? "a sensor"}`}
              transform={`translate(${pole.at[0]} ${-pole.at[1]})`}
              onPointerDown={(event) => event.stopPropagation()}
              onClick={() => props.onToggle(number)}
              onKeyDown={(event) => {
                if (event.key !== "Enter") return;
                event.preventDefault();
                props.onToggle(number);
              }}
            >
              <circle class="hit" r={px(22)} />
              <circle r={px(poles.length > 60 ? 6 : 10)} />
              {poles.length <= 60 && <text font-size={px(pole.id.length > 2 ? 8 : 10.5)} dy=".35em">{pole.id.slice(0, 4)}</text>}
            </g>
          ),
        )}
        {stands.map((stand) => {
          const [x, y] = placeOf(stand, poles);
          const name = stand.pole === null ? "own place" : `pole ${poles[stand.pole].id}`;
          return (
            <g
              key={`s${stand.id}`}
              id={`stand-${stand.id}`}
              class={`stand k${stand.kind % 6}${props.moving ? " moving" : ""}${props.selected === stand.id ? " chosen" : ""}`}
              role="button"
              tabindex={0}
              aria-label={`${kinds[stand.kind]?.name ?? "sensor"} on ${name}, sees ${looks.get(stand.id)?.covered.length ?? 0}; Enter removes it, arrows move it`}
              style={{ transform: `translate(${x}px, ${-y}px)` }}
              onPointerDown={(event) => {
                event.stopPropagation();
                pressed(event, stand);
              }}
              onFocus={() => props.onSelect(stand.id)}
              onKeyDown={(event) => keyed(event, stand)}
            >
              <circle class="hit" r={px(22)} />
              {stand.pole === null ? (
                <rect x={px(-9.5)} y={px(-9.5)} width={px(19)} height={px(19)} rx={px(3)} transform="rotate(45)" />
              ) : (
                <circle r={px(12)} />
              )}
              <text font-size={px(11)} dy=".35em">{stand.pole === null ? "●" : poles[stand.pole].id.slice(0, 4)}</text>
            </g>
          );
        })}
      </svg>
      <div class="zoom">
        <button type="button" aria-label="Zoom in" onClick={() => zoom(0.7)}>+</button>
        <button type="button" aria-label="Zoom out" onClick={() => zoom(1.4)}>−</button>
        <button type="button" aria-label="Whole town" onClick={() => setBox(whole)}>⤢</button>
      </div>
      <Ruler scale={scale} />
      {told && hover && (
        <div class="tip" style={{ left: `${hover.x}px`, top: `${hover.y}px` }}>
          <Told error={told} row={hover.error} stands={stands} poles={poles} looks={looks} />
        </div>
      )}
    </div>
  );
}

const Sign = memo(
  ({ error, row, seen, px, onHover, many }: { error: Wrong; row: number; seen: boolean; px: (n: number) => number; onHover: (h: { error: number; x: number; y: number } | null) => void; many: boolean }) => {
    const [x, y] = error.at;
    const r = px(many ? 2.6 : 4);
    const at = (event: PointerEvent) => {
      const frame = (event.currentTarget as Element).closest(".map")!.getBoundingClientRect();
      onHover({ error: row, x: Math.min(event.clientX - frame.left, frame.width - 272), y: Math.min(event.clientY - frame.top, frame.height - 170) });
    };
    const common = { class: `e ${error.kind}${seen ? " seen" : ""}`, onPointerEnter: at, onPointerLeave: () => onHover(null) };
    if (error.kind === "false_positive")
      return <path {...common} stroke-width={px(2)} d={`M${x - r} ${-y - r}l${2 * r} ${2 * r}m0 ${-2 * r}l${-2 * r} ${2 * r}`} />;
    if (error.kind === "final_error")
      return <path {...common} stroke-width={px(1)} d={`M${x} ${-y - r * 1.2}l${r * 1.15} ${r * 2.1}h${-r * 2.3}Z`} />;
    return <circle {...common} cx={x} cy={-y} r={r} stroke-width={px(1)} />;
  },
  (one, other) => one.seen === other.seen && one.error === other.error && one.px(1) === other.px(1),
);

const NAMES: Record<string, string> = { miss: "missed", false_positive: "false positive", final_error: "final error", point: "point" };
export const wordOf = (kind: string) => NAMES[kind] ?? kind;

export function Told({ error, row, stands, poles, looks }: { error: Wrong; row: number; stands: Stand[]; poles: Pole[]; looks: Map<number, Look> }) {
  const by = stands.filter((each) => looks.get(each.id)?.covered.includes(row));
  const far = (stand: Stand) => {
    const [x, y] = placeOf(stand, poles);
    return Math.hypot(x - error.at[0], y - error.at[1]);
  };
  const near = [...stands].sort((one, other) => far(one) - far(other))[0];
  return (
    <>
      <b>{error.class ?? ""} {wordOf(error.kind)}</b>
      <dl>
        {near && <><dt>nearest sensor</dt><dd>{far(near).toFixed(0)} m</dd></>}
        <dt>seen by</dt><dd>{by.length ? by.map((each) => (each.pole === null ? "own place" : `pole ${poles[each.pole].id}`)).join(", ") : "none"}</dd>
        {error.occlusion != null && <><dt>hidden from the vehicle</dt><dd>{Math.round(error.occlusion * 100)} %</dd></>}
        {error.returns != null && <><dt>LiDAR returns</dt><dd>{error.returns}</dd></>}
        {error.scene && <><dt>sweep of</dt><dd>{error.scene}{error.track ? `, ${error.track}` : ""}</dd></>}
        {error.weight !== 1 && <><dt>weight</dt><dd>{error.weight}</dd></>}
      </dl>
    </>
  );
}

function StreetName({ name, line, px }: { name: string; line: Point[]; px: (n: number) => number }) {
  let total = 0;
  const parts = line.slice(1).map((point, n) => (total += Math.hypot(point[0] - line[n][0], point[1] - line[n][1])));
  if (total < px(7 * name.length) * 0.8) return null;
  const n = parts.findIndex((end) => end >= total / 2);
  const [a, b] = [line[n], line[n + 1]];
  const along = (total / 2 - (n ? parts[n - 1] : 0)) / Math.hypot(b[0] - a[0], b[1] - a[1]);
  let turn = (-Math.atan2(b[1] - a[1], b[0] - a[0]) * 180) / Math.PI;
  if (turn > 90) turn -= 180;
  if (turn < -90) turn += 180;
  const [x, y] = [a[0] + along * (b[0] - a[0]), a[1] + along * (b[1] - a[1])];
  return <text font-size={px(11)} dy=".35em" stroke-width={px(3)} transform={`translate(${x} ${-y}) rotate(${turn})`}>{name}</text>;
}

function Ruler({ scale }: { scale: number }) {
  const metres = [1000, 500, 200, 100, 50, 20, 10, 5, 2].find((each) => each / scale <= 130) ?? 1;
  return (
    <div class="ruler" aria-hidden="true">
      <span style={{ width: `${metres / scale}px` }} />
      {metres} m
    </div>
  );
}
