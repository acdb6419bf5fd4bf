/** What a run recorded, beside its rounds: the drives of a region, a sweep before and after training, a camera picture. */
import { useEffect, useRef, useState } from "preact/hooks";
import type { RefObject } from "preact";
import type { Api } from "./api";
import { DriveView, tellMoment, type Clock } from "./drive";
import { loadScenes } from "./scenes";
import type { SweepData, SweepScene } from "./scene/sweep";
import { nameOf, tellDistance } from "./errors";
import type { Picture, RegionDrive, RunInfo, Workspace } from "./types";

type Asked = { api: Api; run: RunInfo; fail: (error: unknown) => void };

type Driven = { clock: RefObject<Clock>; playing: boolean; region: string; pick: (region: string) => void };

export function Drives({ api, run, fail, clock, playing, region, pick }: Asked & Driven) {
  const { regions } = run.footage;
  const [drives, setDrives] = useState<Record<string, RegionDrive>>({});
  useEffect(() => {
    if (!drives[region]) api.drive(region).then((found) => setDrives((held) => ({ ...held, [region]: found }))).catch(fail);
  }, [region]);
  const shown = drives[region];
  return (
    <section class="footage" aria-label="Drives">
      {regions.length > 1 && (
        <div class="row" role="group" aria-label="Region">
          {regions.map((each) => <button type="button" aria-pressed={each === region} onClick={() => pick(each)}>{each}</button>)}
        </div>
      )}
      {shown ? <DriveView {...{ shown, region, clock, playing }} moments={run.moments} /> : <p class="drive wait" role="status">Reading the drives of {region} …</p>}
      {shown && <p class="note">{tellMoment(shown, region, run.moments[clock.current!.at])} Poses are as recorded; between them they are interpolated.</p>}
    </section>
  );
}

/** A sweep before and after, drawn once it is read; `once` is what it is read for. */
function SweepView({ load, once, fail }: { load: () => Promise<SweepData>; once: string; fail: (error: unknown) => void }) {
  const host = useRef<HTMLDivElement>(null);
  const [told, setTold] = useState<[string, string] | null>(null);
  const [refused, setRefused] = useState("");
  useEffect(() => {
    let made: SweepScene | null = null;
    let gone = false;
    const watch = new IntersectionObserver(([entry]) => {
      if (!entry.isIntersecting) return;
      watch.disconnect();
      Promise.all([load(), loadScenes()]).then(([data, scenes]: [SweepData, Awaited<ReturnType<typeof loadScenes>>]) => {
        if (gone) return;
        setTold(scenes.tellSweep(data));
        try {
          made = new scenes.SweepScene(host.current!, data);
        } catch (error) {
          setRefused((error as Error).message);
        }
      }).catch((error) => [!gone && setRefused((error as Error).message), fail(error)]);
    }, { rootMargin: "200px" });
    watch.observe(host.current!);
    return () => [(gone = true), watch.disconnect(), made?.dispose()] as unknown as void;
  }, [once]);
  return (
    <>
      <div class="sides">{told ? told.map((each) => <p><b>{each.split(": ")[0]}</b> {each.split(": ")[1]}</p>) : !refused && <p class="wait" role="status">Reading the sweep …</p>}</div>
      <div class="sweep" ref={host}>{refused && <p class="refused" role="alert">{refused}</p>}</div>
      <ul class="keys"><li class="found">found</li><li class="missed">missed</li><li class="false">false</li></ul>
    </>
  );
}

export function Sweep({ api, fail }: { api: Api; fail: (error: unknown) => void }) {
  return (
    <section class="footage">
      <h2>A test sweep before and after</h2>
      <SweepView load={() => api.sweep()} once="" fail={fail} />
      <p class="note">Drag to turn, wheel or two fingers to go nearer. The sweep is the test's with the median gain.</p>
    </section>
  );
}

/** The sweep in which an error was made, in a window of its own above the map. */
export function ErrorSweep({ api, space, row, onClose }: { api: Api; space: Workspace; row: number; onClose: () => void }) {
  const dialog = useRef<HTMLDialogElement>(null);
  useEffect(() => dialog.current?.showModal(), []);
  const error = space.errors[row];
  const far = tellDistance(error);
  return (
    <dialog ref={dialog} class="over footage" aria-label="The sweep of an error" onClose={onClose} onKeyDown={(event) => event.stopPropagation()}>
      <h2>{nameOf(error)}{far && `, ${far} from the vehicle`}{error.occlusion != null && `, ${Math.round(error.occlusion * 100)} % hidden from it`}</h2>
      <SweepView load={() => api.errorSweep(space.key, row)} once={`${space.key} ${row}`} fail={() => {}} />
      <p class="note">The arrow marks the error. Both networks look at the sweep anew; boxes are of what has five returns or more. Drag or arrows turn it, wheel, + and − go nearer and away.</p>
      <button type="button" class="primary" onClick={() => dialog.current?.close()}>Back to the map</button>
    </dialog>
  );
}

export function Shot({ api, task, fail }: { api: Api; task: string; fail: (error: unknown) => void }) {
  const [shot, setShot] = useState<Picture | null>(null);
  const [side, setSide] = useState(1);
  useEffect(() => void api.picture(task).then(setShot).catch(fail), [task]);
  const found = shot?.found[Math.min(side, shot.found.length - 1)];
  return (
    <section class="footage">
      <h2>A test picture of {task}</h2>
      {!shot && <p class="wait" role="status">Reading the picture, and looking at it with both networks …</p>}
      {shot && (
        <>
          {shot.found.length > 1 && (
            <div class="row" role="group" aria-label="Network">
              {shot.found.map((each, n) => <button type="button" aria-pressed={n === side} onClick={() => setSide(n)}>{each.title}</button>)}
            </div>
          )}
          <svg class="shot" viewBox={`0 0 ${shot.width} ${shot.height}`} role="img" aria-label={`Camera picture in ${shot.region}: ${shot.labels.length} labelled; ${found ? `${found.title}: ${found.said}` : "no network is kept"}`}>
            <image href={shot.picture} width={shot.width} height={shot.height} />
            {shot.labels.map(([x1, y1, x2, y2]) => <rect class="label" x={x1} y={y1} width={x2 - x1} height={y2 - y1} />)}
            {found?.boxes.map(([x1, y1, x2, y2, name, score]) => (
              <g class="box"><rect x={x1} y={y1} width={x2 - x1} height={y2 - y1} /><text x={x1} y={y1 - 4}>{name.replace("_", " ")} {score.toFixed(2)}</text></g>
            ))}
          </svg>
          <ul class="keys"><li class="label">labelled: {[...new Set(shot.labels.map((each) => each[4].replace("_", " ")))].join(", ") || "nothing"}</li>{found && <li class="found">{found.title}: {found.said}</li>}</ul>
        </>
      )}
    </section>
  );
}
