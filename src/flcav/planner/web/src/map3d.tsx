/** The map in three dimensions: scenery drawn by three.js; poles and sensors above it are buttons, as on the flat map. */
import { useEffect, useLayoutEffect, useRef, useState } from "preact/hooks";
import { besides, hasSweep, pressErrorKey, tellError, Tip } from "./errors";
import { loadScenes } from "./scenes";
import { MOUNT_M, pressKey, settleAt, useCarried, type MapProps } from "./standing";
import type { TownScene } from "./scene/town";
import type { Point, Stand } from "./types";

export function Town3D({ fail, keep, ...props }: MapProps & { fail: (error: unknown) => void; keep: (scene: TownScene | null) => void }) {
  const { space, stands, kinds, looks, covered, shown, news } = props;
  const { map, poles, errors } = space;
  const host = useRef<HTMLDivElement>(null);
  const pins = useRef<HTMLDivElement>(null);
  const [scene, setScene] = useState<TownScene | null>(null);
  const [refused, setRefused] = useState("");
  const [hover, setHover] = useState<number | null>(null);
  const [theme, setTheme] = useState(0);
  const drag = useRef<{ stand: Stand; from: Point; moved: boolean } | null>(null);

  useEffect(() => {
    const dark = matchMedia("(prefers-color-scheme: dark)");
    const changed = () => setTheme((count) => count + 1);
    dark.addEventListener("change", changed);
    return () => dark.removeEventListener("change", changed);
  }, []);
  useEffect(() => {
    let made: TownScene | null = null;
    let gone = false;
    loadScenes().then(
      ({ TownScene }) => {
        if (gone) return;
        try {
          made = new TownScene(host.current!, map, poles.map((pole) => pole.at));
          [setScene(made), keep(made)];
        } catch (error) {
          setRefused((error as Error).message);
        }
      },
      (error) => [setRefused(error.message), fail(error)],
    );
    return () => [(gone = true), keep(null), made?.dispose(), setScene(null)] as unknown as void;
  }, [space.key, theme]);

  const mountOf = (stand: Stand): [number, number, number] => {
    if (stand.pole !== null) return poles[stand.pole].at;
    return [stand.x, stand.y, looks.get(stand.id)?.z ?? MOUNT_M];
  };
  useEffect(() => {
    if (!scene) return;
    const colour = (name: string) => getComputedStyle(host.current!).getPropertyValue(`--${name}`).trim();
    const signs = errors.map((error, row) => ({
      at: error.at,
      colour: !shown[row] ? "" : colour(covered.has(row) ? "seen" : error.kind === "false_positive" ? "false" : "miss"),
      cross: error.kind === "false_positive",
    }));
    const sensors = stands.map((stand) => ({
      at: mountOf(stand),
      colour: colour(`k${stand.kind % 6}`),
      area: props.sight ? (looks.get(stand.id)?.area ?? "M0 0Z") : "",
      range: kinds[stand.kind]?.range_m ?? 0,
      chosen: props.selected === stand.id,
    }));
    scene.show(sensors, signs);
  }, [scene, stands, looks, covered, shown, props.selected, props.sight, kinds, [...looks.values()].map((each) => each.area.length).join()]);

  /** Put every button where its place is seen. */
  const place = () => {
    for (const pin of pins.current?.children ?? []) {
      const button = pin as HTMLElement;
      const at = scene?.project(button.dataset.at!.split(",").map(Number) as [number, number, number]);
      button.style.visibility = at ? "" : "hidden";
      if (at) button.style.transform = `translate(${at[0].toFixed(1)}px, ${at[1].toFixed(1)}px)`;
    }
  };
  useLayoutEffect(() => {
    if (scene) scene.onMove = place;
    place();
  });

  const toWorld = (event: { clientX: number; clientY: number }) => scene?.groundAt(event) ?? null;
  useCarried(props, host, toWorld);
  const moved = (event: PointerEvent) => {
    const held = drag.current;
    if (!held) return;
    if (!held.moved && Math.hypot(event.clientX - held.from[0], event.clientY - held.from[1]) < 4) return;
    const at = toWorld(event);
    const next = at && settleAt(at, held.stand, props);
    if (!next) return;
    drag.current = { stand: next, from: held.from, moved: true };
    props.onDrag(next);
  };
  const released = () => {
    const held = drag.current;
    drag.current = null;
    if (held?.moved) props.onPut(held.stand, false);
    else if (held) props.onSelect(held.stand.id);
  };
  const look = (event: PointerEvent) => {
    if (event.buttons || !scene || event.target !== host.current?.firstChild) return setHover(null);
    setHover(event.pointerType === "mouse" ? scene.errorAt(event) : null);
  };
  const press = useRef<Point | null>(null); // where the pointer went down
  const hold = (event: PointerEvent) => {
    const from = press.current;
    press.current = null;
    if (!from || !scene || Math.hypot(event.clientX - from[0], event.clientY - from[1]) > 4) return;
    props.onHold(scene.errorAt(event));
  };
  const told = hover ?? props.held;
  const first = props.held !== null && shown[props.held] ? props.held : shown.indexOf(true);
  const goTo = (row: number) => {
    props.onHold(row);
    requestAnimationFrame(() => document.querySelector<HTMLElement>(".pin.error")?.focus());
  };
  const frame: Point = [host.current?.clientWidth ?? 800, host.current?.clientHeight ?? 600];

  const occupied = new Set(stands.map((each) => each.pole));
  return (
    <div class="map solid">
      <div class="scene" ref={host} onPointerMove={look} onPointerLeave={() => setHover(null)} onPointerDown={(event) => (press.current = [event.clientX, event.clientY])} onPointerUp={hold} />
      {refused ? <p class="refused" role="alert">{refused}</p> : !scene && <p class="refused" role="status">Drawing the town …</p>}
      <div class="pins" ref={pins}>
        {first >= 0 && (
          <button
            type="button"
            class={`pin error${first === props.held ? " chosen" : ""}`}
            data-at={errors[first].at.join()}
            aria-label={tellError(errors[first], covered.has(first), hasSweep(props, errors[first]))}
            onFocus={() => props.onHold(first)}
            onKeyDown={(event) => pressErrorKey(event, first, props, goTo)}
          />
        )}
        {poles.map((pole, number) =>
          occupied.has(number) ? null : (
            <button
              type="button"
              key={`p${number}`}
              id={`pole-${number}`}
              class={`pin${poles.length > 60 ? " small" : ""}`}
              data-at={pole.at.join()}
              aria-label={`Pole ${pole.id}${pole.street ? `, ${pole.street}` : ""}: place ${kinds[props.kind]?.name ?? "a sensor"}`}
              onClick={() => props.onToggle(number)}
            >
              {poles.length > 60 ? "" : pole.id.slice(0, 4)}
            </button>
          ),
        )}
        {stands.map((stand) => (
          <button
            type="button"
            key={`s${stand.id}`}
            id={`stand-${stand.id}`}
            class={`pin stand k${stand.kind % 6}${props.selected === stand.id ? " chosen" : ""}${stand.pole === null ? " own" : ""}`}
            data-at={mountOf(stand).join()}
            aria-label={`${kinds[stand.kind]?.name ?? "sensor"} on ${stand.pole === null ? "own place" : `pole ${poles[stand.pole].id}`}, sees ${looks.get(stand.id)?.covered.length ?? 0}; Enter removes it, arrows move it`}
            onPointerDown={(event) => {
              if (event.button > 0) return;
              event.currentTarget.setPointerCapture(event.pointerId);
              drag.current = { stand, from: [event.clientX, event.clientY], moved: false };
            }}
            onPointerMove={moved}
            onPointerUp={released}
            onPointerCancel={released}
            onFocus={() => props.onSelect(stand.id)}
            onKeyDown={(event) => pressKey(event, stand, props)}
          >
            {stand.pole === null ? "●" : poles[stand.pole].id.slice(0, 4)}
          </button>
        ))}
        {news.map((found, number) => (
          <span key={`n${number}`} class="pin new" data-at={[found.site.x, found.site.y, MOUNT_M].join()}>+{Math.round(found.gain * 10) / 10}</span>
        ))}
      </div>
      {told !== null && shown[told] && scene?.project(errors[told].at) && (
        <Tip {...props} row={told} stays={told === props.held} at={besides(scene.project(errors[told].at)!, frame)} />
      )}
    </div>
  );
}

