/** The map: a town in metres, its errors, poles and sensors, with pointer and keyboard. */
import { memo } from "preact/compat";
import { useEffect, useLayoutEffect, useMemo, useRef, useState } from "preact/hooks";
import { besides, hasSweep, pressErrorKey, Sign, Tip } from "./errors";
import { placeOf, pressKey, settleAt, useCarried, type MapProps } from "./standing";
import type { Point, Stand, TownMap } from "./types";

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
const [TOUCH_PX, MOUSE_PX] = [18, 7]; // how near a press is to the error that is meant

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
  const [hover, setHover] = useState<number | null>(null);
  const press = useRef<Point | null>(null); // where the pointer went down, until it moves
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
    press.current = stand || fingers.current.size > 1 ? null : [event.clientX, event.clientY];
    drag.current = stand && fingers.current.size === 1 ? { stand, fresh: false, moved: false } : null;
  };
  const moved = (event: PointerEvent) => {
    const before = fingers.current.get(event.pointerId);
    if (!before) return;
    const now: Point = [event.clientX, event.clientY];
    if (press.current && Math.hypot(now[0] - press.current[0], now[1] - press.current[1]) > 4) press.current = null;
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
  /** Tell of the error that is pressed, the nearest within reach of a finger or of the mouse, or of none. */
  const hold = (event: PointerEvent) => {
    const [x, y] = toWorld(event);
    const far = (row: number) => Math.hypot(errors[row].at[0] - x, errors[row].at[1] - y);
    const near = errors.reduce((best, _, row) => (shown[row] && (best < 0 || far(row) < far(best)) ? row : best), -1);
    const meant = near >= 0 && far(near) <= px(event.pointerType === "mouse" ? MOUSE_PX : TOUCH_PX);
    if (meant) focusError(near);
    else props.onHold(null);
  };
  const focusError = (row: number) => {
    props.onHold(row);
    document.getElementById(`error-${row}`)?.focus({ preventScroll: true });
  };
  const released = (event: PointerEvent) => {
    fingers.current.delete(event.pointerId);
    const done = drag.current;
    drag.current = null;
    if (press.current && event.type === "pointerup") hold(event);
    press.current = null;
    if (!done) return;
    if (done.moved) props.onPut(done.stand, false);
    else props.onSelect(done.stand.id);
  };

  useCarried(props, svg, toWorld);
  const keyed = (event: KeyboardEvent, stand: Stand) => pressKey(event, stand, props);

  const latest = useRef<(event: KeyboardEvent, row: number) => void>(() => {}); // signs are drawn anew only where they change
  latest.current = (event, row) => pressErrorKey(event, row, props, focusError);
  const occupied = new Set(stands.map((each) => each.pole));
  const told = hover ?? props.held;
  const first = props.held !== null && shown[props.held] ? props.held : shown.indexOf(true);
  const onPage = ([x, y]: Point | [number, number, number]): Point => [
    size[0] / 2 + (x - box.x - box.w / 2) / scale,
    size[1] / 2 + (-y - box.y - box.h / 2) / scale,
  ];
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
        <g class="errors" role="group" aria-label={`${errors.length} ${space.noun}s: arrows go from one to the next`}>
          {errors.map((error, row) =>
            shown[row] ? (
              <Sign
                key={row}
                {...{ error, row, px }}
                seen={covered.has(row)}
                many={errors.length > 400}
                first={row === first}
                opens={hasSweep(props, error)}
                onHover={setHover}
                onHold={props.onHold}
                onKey={(event, at) => latest.current(event, at)}
              />
            ) : null,
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
      {told !== null && shown[told] && <Tip {...props} row={told} stays={told === props.held} at={besides(onPage(errors[told].at), size)} />}
    </div>
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
