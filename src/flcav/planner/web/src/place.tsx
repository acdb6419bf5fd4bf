/** The tab Place: a map with sensors, and beside it what they cover, what could be covered, and what that costs. */
import { useEffect, useLayoutEffect, useMemo, useRef, useState } from "preact/hooks";
import { Unreachable, type Api } from "./api";
import { Curve } from "./curve";
import { saveBlob, saveMap, saveText } from "./saving";
import type { TownScene } from "./scene/town";
import { KindsSection, number } from "./kinds";
import { useLooks } from "./looks";
import { wordOf } from "./errors";
import { ErrorSweep } from "./footage";
import { TownView } from "./map";
import { Town3D } from "./map3d";
import { Bar, Command, Legend } from "./parts";
import { placeOf } from "./standing";
import type { Best, NewPole, Placing, Stand, Workspace } from "./types";

type Props = {
  api: Api;
  space: Workspace;
  placing: Placing;
  setPlacing: (next: Placing, forget?: boolean) => void;
  undo: (() => void) | null;
  solid: boolean; // whether the map is shown in three dimensions
  setSolid: (solid: boolean) => void;
  say: (text: string) => void;
  fail: (error: unknown) => void;
};

const plural = (count: number, noun: string) => `${count} ${noun}${count === 1 ? "" : "s"}`;

export function Place({ api, space, placing, setPlacing, undo, solid, setSolid, say, fail }: Props) {
  const scene = useRef<TownScene | null>(null);
  const [drag, setDrag] = useState<Stand | null>(null);
  const [kind, setKind] = useState(0);
  const [selected, setSelected] = useState<number | null>(null);
  const [carried, setCarried] = useState<number | null>(null);
  const [best, setBest] = useState<Best | null>(null); // at the same cost, or without prices of as many sensors
  const [asMany, setAsMany] = useState<Best | null>(null); // with prices: of as many sensors, whatever they cost
  const [bestFor, setBestFor] = useState("");
  const [refused, setRefused] = useState("");
  const [unfit, setUnfit] = useState(""); // why the wished placement cannot be
  const [curve, setCurve] = useState<Best[] | null>(null);
  const [news, setNews] = useState<NewPole[]>([]);
  const [sought, setSought] = useState(false);
  const [held, setHeld] = useState<number | null>(null);
  const [swept, setSwept] = useState<number | null>(null); // the error whose sweep is shown
  const [moving, setMoving] = useState(false);
  const priced = placing.kinds.some((each) => each.cost > 0) || space.poles.some((each) => each.cost > 0);
  const { kinds, without, sight } = placing;

  const stands = useMemo(() => {
    if (!drag) return placing.stands;
    return placing.stands.some((each) => each.id === drag.id)
      ? placing.stands.map((each) => (each.id === drag.id ? drag : each))
      : [...placing.stands, drag];
  }, [placing.stands, drag]);
  const { looks, settled } = useLooks(api, space, placing, stands, fail);

  const shown = useMemo(
    () => space.errors.map((error) => !without.includes(error.kind) && !without.includes(error.class ?? "")),
    [space.errors, without],
  );
  const { covered, alone } = useMemo(() => {
    const times = new Map<number, number>();
    for (const stand of stands) for (const row of looks.get(stand.id)?.covered ?? []) if (shown[row]) times.set(row, (times.get(row) ?? 0) + 1);
    const alone = new Map(
      stands.map((stand) => [stand.id, (looks.get(stand.id)?.covered ?? []).filter((row) => times.get(row) === 1).length]),
    );
    return { covered: new Set(times.keys()), alone };
  }, [stands, looks, shown, settled, [...looks.values()].map((each) => each.covered.length).join()]);
  const weigh = (rows: Iterable<number>) => [...rows].reduce((sum, row) => sum + space.errors[row].weight, 0);
  const total = shown.filter(Boolean).length;
  const weight = weigh(covered);
  const even = space.errors.every((error) => error.weight === 1);
  const cost = stands.reduce(
    (sum, each) => sum + kinds[each.kind].cost + (each.pole === null ? 0 : space.poles[each.pole].cost),
    0,
  );

  // The best placement, and the curve, follow what is placed; the last question that was asked is the one answered.
  const asked = JSON.stringify([space.key, kinds, without, sight, stands.filter((each) => each.pole === null).map((each) => [each.x, each.y])]);
  const count = { count: placing.stands.length };
  const limit = priced ? { budget: Math.round(cost * 1e6) / 1e6 } : count;
  const bestAsked = JSON.stringify([asked, limit, count]);
  useEffect(() => {
    if (!space.errors.length || !placing.stands.length || drag) return;
    let current = true;
    const later = setTimeout(() => {
      performance.mark("best-asked");
      Promise.all([api.best(space.key, placing, limit), priced && !api.saved ? api.best(space.key, placing, count) : null])
        .then(([found, other]) => {
          performance.measure("best", "best-asked");
          if (current) [setBest(found), setAsMany(other), setBestFor(bestAsked), setRefused("")];
        })
        .catch((error) => current && [setBest(null), setRefused(String(error.message))]);
    }, 60);
    return () => [clearTimeout(later), (current = false)];
  }, [bestAsked, !drag, placing.stands.length > 0]);
  useEffect(() => {
    if (!space.errors.length || drag) return;
    let current = true;
    const later = setTimeout(() => {
      api.curve(space.key, placing).then((steps) => current && setCurve(steps)).catch(() => current && setCurve([]));
    }, 250);
    return () => [clearTimeout(later), (current = false)];
  }, [asked, !drag]);
  useEffect(() => setUnfit(""), [asked, placing.stands.length]);
  useEffect(() => [setNews([]), setSought(false)] as unknown as void, [asked, JSON.stringify(placing.stands)]);

  const put = (stand: Stand, fresh: boolean) => {
    setDrag(null);
    const id = fresh ? 1 + Math.max(0, ...placing.stands.map((each) => each.id)) : stand.id;
    const next = { ...stand, id };
    setPlacing({
      ...placing,
      stands: fresh ? [...placing.stands, next] : placing.stands.map((each) => (each.id === id ? next : each)),
    });
    setSelected(id);
  };
  const toggle = (pole: number) => {
    const id = 1 + Math.max(0, ...placing.stands.map((each) => each.id));
    setPlacing({ ...placing, stands: [...placing.stands, { id, pole, x: 0, y: 0, kind }] });
    setSelected(id);
    requestAnimationFrame(() => document.getElementById(`stand-${id}`)?.focus());
  };
  const remove = (stand: Stand) => {
    setPlacing({ ...placing, stands: placing.stands.filter((each) => each.id !== stand.id) });
    setSelected(null);
    if (stand.pole !== null) requestAnimationFrame(() => document.getElementById(`pole-${stand.pole}`)?.focus());
  };
  const range = (which: number, by: number) => setKindField(which, { range_m: Math.min(2000, Math.max(1, kinds[which].range_m + by)) });
  const setKindField = (which: number, fields: Partial<Placing["kinds"][0]>) =>
    setPlacing({ ...placing, kinds: kinds.map((each, n) => (n === which ? { ...each, ...fields } : each)) });

  /** Move the sensors to a placement: each of the best ones takes the nearest of those that are there. */
  const show = (target: Best) => {
    const free = [...placing.stands];
    const own = placing.stands.filter((each) => each.pole === null);
    let id = Math.max(0, ...placing.stands.map((each) => each.id));
    const next = target.pairs.map(([site, of]): Stand => {
      const poles = space.poles.length;
      const at: Stand = site < poles ? { id: 0, pole: site, x: 0, y: 0, kind: of } : { ...own[site - poles], kind: of };
      const [x, y] = placeOf(at, space.poles);
      free.sort((a, b) => {
        const [ax, ay] = placeOf(a, space.poles);
        const [bx, by] = placeOf(b, space.poles);
        return Math.hypot(ax - x, ay - y) - Math.hypot(bx - x, by - y);
      });
      return { ...at, id: free.shift()?.id ?? ++id };
    });
    setMoving(true);
    setTimeout(() => setMoving(false), 700);
    setPlacing({ ...placing, stands: next });
    setSelected(null);
  };
  const optimum = () => {
    const target = placing.stands.length ? best : curve?.[Math.min(2, (curve?.length ?? 1) - 1)];
    if (target) show(target);
  };

  useLayoutEffect(() => {
    const keyed = (event: KeyboardEvent) => {
      if ((event.target as Element).matches("input, select, textarea") || event.ctrlKey || event.metaKey || event.altKey) return;
      if (event.key === "o" || event.key === "O") optimum();
      else if (event.key === "z" || event.key === "Z") undo?.();
      else if (event.key === "[" || event.key === "]") range(kind, event.key === "]" ? 1 : -1);
      else return;
      event.preventDefault();
    };
    window.addEventListener("keydown", keyed);
    return () => window.removeEventListener("keydown", keyed);
  });

  const noun = space.noun;
  const fair = !api.saved || without.length === 0;
  const current = best && bestFor === bestAsked && !drag && placing.stands.length ? best : null;
  const after = !priced && current ? curve?.find((each) => each.pairs.length === placing.stands.length + 1) : null;
  const more = after && current && fair ? { ...after, gain: Math.max(even ? after.covered - current.covered : after.weight - current.weight, 0) } : null;
  const withAsMany = `with ${plural(placing.stands.length, "sensor")}`;
  const told = (found: Best) => (
    <>
      <b>{even ? found.covered : number(found.weight)}</b>
      {!even && " in weight"}
      {found.optimal ? ", proven" : `, at most ${number(found.bound)} (gap ${number((100 * (found.bound - found.weight)) / found.weight)} %)`}
      {api.saved && ", precomputed"}
    </>
  );
  const wish = (event: Event, limit: { count?: number; budget?: number }) => {
    event.preventDefault();
    setUnfit("");
    api.best(space.key, placing, limit).then(show).catch((error: Error) => (error instanceof Unreachable ? fail(error) : setUnfit(`No placement: ${error.message}.`)));
  };
  const wished = (event: Event, name: string) => Number(new FormData(event.currentTarget as HTMLFormElement).get(name));
  const beyond = current?.beyond ?? curve?.[0]?.beyond ?? null;
  useEffect(() => {
    if (!drag && settled && space.errors.length && placing.stands.length) say(`${covered.size} of ${total} ${noun}s covered by ${plural(placing.stands.length, "sensor")}`);
  }, [covered.size, total, settled, !drag, placing.stands.length]);

  const counts = (of: (row: number) => string | undefined) => {
    const found = new Map<string, number>();
    space.errors.forEach((_, row) => {
      const name = of(row);
      if (name) found.set(name, (found.get(name) ?? 0) + 1);
    });
    return [...found];
  };
  const filters = api.saved ? [] : [...counts((row) => space.errors[row].kind), ...counts((row) => space.errors[row].class)];

  const shownOn = {
    ...{ space, stands, kinds, looks, covered, shown, kind, sight, news, moving, carried, selected },
    onlyPoles: api.saved,
    onCarried: () => setCarried(null),
    onDrag: setDrag,
    onPut: put,
    onToggle: toggle,
    onRemove: remove,
    onRange: range,
    onSelect: setSelected,
    held,
    onHold: setHeld,
    onSweep: setSwept,
  };
  useEffect(() => [setHeld(null), setSwept(null)] as unknown as void, [space.key]);
  return (
    <div class="place">
      <main class="stage">
      <h1 class="said">Sensors in {space.map.name}</h1>
      {solid ? <Town3D {...shownOn} fail={fail} keep={(made) => (scene.current = made)} /> : <TownView {...shownOn} />}
      <div class="views" role="group" aria-label="View">
        <button type="button" aria-pressed={!solid} onClick={() => setSolid(false)}>Above</button>
        <button type="button" aria-pressed={solid} onClick={() => setSolid(true)}>3D</button>
      </div>
      {swept !== null && <ErrorSweep {...{ api, space }} row={swept} onClose={() => [setSwept(null), document.getElementById(`error-${swept}`)?.focus()]} />}
      <Legend space={space} covered={placing.stands.length > 0} solid={solid} />
      </main>
      <aside class="panel" aria-label="Sensors and what they cover">
        {space.errors.length > 0 ? (
          <section class="headline">
            <p class="big">
              <strong id="covered">{covered.size}</strong> of <span id="total">{total}</span> {noun}s covered
            </p>
            <Bar total={total} covered={covered.size} best={current?.covered ?? null} beyond={beyond} />
            <ul class="facts">
              {current && fair && (
                <li id="best">
                  Best possible {priced ? `for ${number(cost)}` : withAsMany}: {told(current)}
                  {!even && ` · yours: ${number(weight)}`}
                </li>
              )}
              {current && fair && priced && asMany && (
                <li id="as-many">
                  {withAsMany[0].toUpperCase() + withAsMany.slice(1)}, whatever they cost: {told(asMany)}, for {number(asMany.cost)}{" "}
                  <button type="button" class="quiet" onClick={() => show(asMany)}>Show it</button>
                </li>
              )}
              {!current && placing.stands.length > 0 && <li class="wait">{refused || (drag ? "Best possible: when you let go" : "Computing the best possible …")}</li>}
              {!placing.stands.length && <li>Drag a sensor onto the map, or press a pole. O shows the optimum.</li>}
              {more && <li id="next">With one more: <b>{even ? more.covered : number(more.weight)}</b> at best, {more.gain > 0 ? `+${number(more.gain)}` : "nothing more"}</li>}
              {beyond !== null && <li id="beyond"><b>{beyond}</b> out of reach of every {placing.stands.some((each) => each.pole === null) ? "pole and place of yours" : "pole"}</li>}
              {priced && placing.stands.length > 0 && <li>Cost: <b id="cost">{number(cost)}</b></li>}
            </ul>
            <div class="row">
              <button type="button" class="primary" onClick={optimum} disabled={!current && !(curve?.length && !placing.stands.length)}>Show the optimum <kbd>O</kbd></button>
              <button type="button" onClick={() => undo?.()} disabled={!undo}>Undo <kbd>Z</kbd></button>
              <button type="button" onClick={() => setPlacing({ ...placing, stands: [] })} disabled={!placing.stands.length}>Clear</button>
            </div>
            {!api.saved && priced && (
              <form class="wish" onSubmit={(event) => wish(event, { budget: wished(event, "cost") })}>
                <label>The best for a cost of <input name="cost" type="number" required min={0} step="any" /></label>
                <button type="submit">Show</button>
              </form>
            )}
            {!api.saved && (
              <form class="wish" onSubmit={(event) => wish(event, { count: Math.round(wished(event, "count")) })}>
                <label>The best with <input name="count" type="number" required min={1} step={1} /> sensors</label>
                <button type="submit">Show</button>
              </form>
            )}
            {unfit && <p class="unfit" role="alert">{unfit}</p>}
          </section>
        ) : (
          <section class="headline">
            <p class="big">No errors yet</p>
            <p>
              {api.saved ? "This page was saved without errors." : "Drop a table on the map: errors that flcav errors wrote, or accidents of your own (.csv with x, y or latitude, longitude). Until then sensors show what they see."}
            </p>
          </section>
        )}

        <KindsSection {...{ placing, setPlacing, kind, setKind, priced, range, setKindField, setCarried }} fixed={api.saved} />

        {placing.stands.length > 0 && (
          <section>
            <h2>{plural(placing.stands.length, "sensor")}</h2>
            <ol class="stands" id="stands">
              {placing.stands.map((stand) => {
                const pole = stand.pole === null ? null : space.poles[stand.pole];
                const sees = (looks.get(stand.id)?.covered ?? []).filter((row) => shown[row]).length;
                return (
                  <li key={stand.id} class={selected === stand.id ? "on" : ""}>
                    <button type="button" class="pick" onClick={() => setSelected(stand.id)}>
                      <b>{pole ? `Pole ${pole.id}` : `At ${number(stand.x)}, ${number(stand.y)}`}</b>
                      {pole?.street && <span> {pole.street}</span>}
                      {space.errors.length > 0 && <small>{plural(sees, noun)}, {alone.get(stand.id)} by it alone</small>}
                    </button>
                    {kinds.length > 1 && (
                      <select aria-label="Kind of this sensor" value={stand.kind} onChange={(event) => put({ ...stand, kind: Number(event.currentTarget.value) }, false)}>
                        {kinds.map((each, n) => <option value={n}>{each.name}</option>)}
                      </select>
                    )}
                    <button type="button" class="quiet" aria-label={`Remove the sensor ${pole ? `on pole ${pole.id}` : "at your place"}`} onClick={() => remove(stand)}>×</button>
                  </li>
                );
              })}
            </ol>
          </section>
        )}

        {curve && curve.length > 0 && fair && (
          <section>
            <h2>{priced ? "Coverage against cost" : "Coverage against sensors"}</h2>
            <Curve
              steps={curve}
              priced={priced}
              even={even}
              total={even ? total : weigh(shown.flatMap((is, row) => (is ? [row] : [])))}
              yours={placing.stands.length ? { x: priced ? cost : placing.stands.length, y: even ? covered.size : weight } : null}
              onPick={show}
            />
            {api.saved && <p class="note">Precomputed; the optimum of each number of sensors.</p>}
          </section>
        )}

        {space.errors.length > 0 && !api.saved && (
          <section>
            <h2>A new pole</h2>
            <p class="note">Beside which street would one more {kinds[kind].name} see most of what is not covered yet?</p>
            {!sought && (
              <button type="button" onClick={() => api.newPoles(space.key, placing, kind, [...shown.keys()].filter((row) => shown[row] && !covered.has(row))).then((found) => [setNews(found), setSought(true)]).catch(fail)}>
                Find the place
              </button>
            )}
            {sought && !news.length && <p>No place beside a street sees any more of them.</p>}
            {news.length > 0 && <ol class="stands">
              {news.map((place) => (
                <li>
                  <span class="pick"><b>+{number(place.gain)}</b> {place.site.street ?? "beside the road"}<small>x {number(place.site.x)}, y {number(place.site.y)} m</small></span>
                  <button type="button" onClick={() => put({ id: 0, pole: null, x: Math.round(place.site.x * 10) / 10, y: Math.round(place.site.y * 10) / 10, kind }, true)}>Stand one there</button>
                </li>
              ))}
            </ol>}
          </section>
        )}

        {!api.saved && (
          <section>
            <h2>What counts</h2>
            <label class="check"><input type="checkbox" checked={sight} onChange={() => setPlacing({ ...placing, sight: !sight })} /> Houses and trees{space.traffic ? " and traffic" : ""} are in the way</label>
            {filters.length > 1 && (
              <div class="chips" role="group" aria-label="Errors that count">
                {filters.map(([name, count]) => (
                  <button type="button" aria-pressed={!without.includes(name)} onClick={() => setPlacing({ ...placing, without: without.includes(name) ? without.filter((each) => each !== name) : [...without, name] })}>
                    {wordOf(name)} <small>{count}</small>
                  </button>
                ))}
              </div>
            )}
            {space.notes.map((note) => <p class="note">{note}</p>)}
          </section>
        )}

        <section>
          <h2>Take it with you</h2>
          <div class="chips">
            {!api.saved && (["csv", "geojson", "yaml"] as const).map((ending) => (
              <button type="button" disabled={!placing.stands.length} onClick={() => api.files(space.key, placing).then((files) => saveText(files[ending], `sensors.${ending}`)).catch(fail)}>
                {{ csv: "CSV", geojson: "GeoJSON", yaml: "Recipe" }[ending]}
              </button>
            ))}
            {!solid && <button type="button" onClick={() => saveMap("svg", space.map.name)}>SVG</button>}
            <button type="button" onClick={() => (solid ? scene.current?.picture((png) => png && saveBlob(png, `${space.map.name}.png`)) : saveMap("png", space.map.name))}>PNG</button>
            {!api.saved && <button type="button" onClick={() => navigator.clipboard.writeText(location.href).then(() => say("The link is copied"), fail)}>Copy link</button>}
          </div>
          <Command api={api} space={space} placing={placing} say={say} fail={fail} />
        </section>
      </aside>
    </div>
  );
}
