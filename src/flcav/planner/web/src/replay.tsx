/** The tab Replay: a finished run, played moment by moment: scores, messages of every server, the ledger that fills. */
import { useEffect, useLayoutEffect, useRef, useState } from "preact/hooks";
import type { Played } from "./address";
import type { Api } from "./api";
import type { Clock } from "./drive";
import { Drives, Shot, Sweep } from "./footage";
import type { Moment, RunInfo } from "./types";

const LINKS = ["wireless", "wireline"] as const;
const STEP_MS = 700; // that a moment lasts
const [DRIVE_MS, ROUND_MS] = [6000, 1600]; // where drives are shown: of pretraining, and of a round
const mean = (moment: Moment) => {
  const scores = Object.values(moment.scores);
  return scores.reduce((sum, each) => sum + each, 0) / Math.max(scores.length, 1);
};
const signed = (value: number) => (value < 0 ? "−" : "+") + Math.abs(value).toFixed(3);

/** The round whose mean score over regions rose most. */
export function findBestRound(moments: Moment[]): { at: number; gain: number } | null {
  let best: { at: number; gain: number } | null = null;
  moments.forEach((moment, n) => {
    if (!n || !Object.keys(moments[n - 1].scores).length) return;
    const gain = mean(moment) - mean(moments[n - 1]);
    if (!best || gain > best.gain) best = { at: n, gain };
  });
  return best;
}

type Props = { api: Api; run: RunInfo; played: Played; setPlayed: (played: Played) => void; say: (text: string) => void; fail: (error: unknown) => void };

export function Replay({ api, run, played, setPlayed, say, fail }: Props) {
  const { moments, footage } = run;
  const at = Math.min(played.moment, moments.length - 1);
  const region = footage.regions.includes(played.region) ? played.region : (footage.regions[0] ?? "");
  const clock = useRef<Clock>({ at, part: 1 });
  const [playing, setPlaying] = useState(false);
  const moment = moments[at];
  const best = findBestRound(moments);
  const setAt = (to: number, part: number) => {
    clock.current = { at: to, part };
    setPlayed({ region, moment: to });
  };
  const go = (to: number) => setAt(Math.min(Math.max(to, 0), moments.length - 1), playing ? 0 : 1);
  const play = () => {
    if (!playing) setAt(at === moments.length - 1 ? 0 : at, 0);
    setPlaying(!playing);
  };
  useEffect(() => {
    if (!playing) return;
    const drives = footage.regions.length > 0;
    const lasts = drives ? (moment.stage === "pretrain" ? DRIVE_MS : ROUND_MS) : STEP_MS;
    let asked = 0;
    let before = performance.now();
    const turn = (now: number) => {
      clock.current!.part += (now - before) / lasts;
      before = now;
      if (clock.current!.part < 1) asked = requestAnimationFrame(turn);
      else if (at < moments.length - 1) setAt(at + 1, 0);
      else [setAt(at, 1), setPlaying(false)];
    };
    asked = requestAnimationFrame(turn);
    return () => cancelAnimationFrame(asked);
  }, [playing, at]);
  useLayoutEffect(() => {
    const keyed = (event: KeyboardEvent) => {
      const target = event.target as Element;
      if (target.matches("button") ? event.key === " " : target.matches("input") && event.key !== " ") return; // theirs
      if (event.key === " ") play();
      else if (event.key === "ArrowRight") go(clock.current!.at + 1);
      else if (event.key === "ArrowLeft") go(clock.current!.at - 1);
      else return;
      event.preventDefault();
    };
    window.addEventListener("keydown", keyed);
    return () => window.removeEventListener("keydown", keyed);
  });
  useEffect(() => say(`${moment.told}: ${Object.entries(moment.scores).map(([name, score]) => `${name} ${score.toFixed(3)}`).join(", ")}`), [at]);
  return (
    <div class="replay">
      <main class="sheet">
        <h1>{run.name}</h1>
        <div class="player">
          <button type="button" class="primary" onClick={play}>{playing ? "❚❚ Pause" : "▶ Play"} <kbd>Space</kbd></button>
          <input type="range" min={0} max={moments.length - 1} value={at} aria-label="Moment of the run" aria-valuetext={moment.told} onInput={(event) => go(Number(event.currentTarget.value))} />
          <output id="moment">{moment.told}</output>
        </div>
        {footage.regions.length > 0 && <Drives {...{ api, run, fail, clock, playing, region }} pick={(name) => setPlayed({ region: name, moment: at })} />}
        <Scores run={run} at={at} best={best && best.gain > 0 ? best.at : -1} onPick={go} />
        {best && best.gain <= 0 && <p id="gained">No round gained: the mean of the regions' scores never rose, on {run.frames} validation frames each.</p>}
        {best && best.gain > 0 && (
          <p id="gained">
            <b>{moments[best.at].told}</b> gained most: <b>{signed(best.gain)}</b> in the mean of {Object.keys(moments[best.at].scores).length} regions, on {run.frames} validation frames each.{" "}
            <button type="button" class="quiet" onClick={() => go(best.at)}>Go there</button>
          </p>
        )}
        <div class="servers">
          {moment.servers.map((each) => (
            <article class="task" key={`${each.server} ${each.task}`}>
              <h2>{each.server} <small>{each.task}</small></h2>
              <div class="pulses" aria-hidden="true" key={at}>
                {Array.from({ length: Math.min(each.clients.length, 24) }, (_, n) => <i style={{ animationDelay: `${n * 40}ms` }} />)}
              </div>
              <p class="note">
                {each.clients.length} {each.server === "cloud" ? "server" : "vehicle"}{each.clients.length === 1 ? "" : "s"}{each.failed ? `, ${each.failed} failed` : ""} · {each.up_mb.toFixed(2)} MB up{each.loss === null ? "" : ` · loss ${each.loss.toFixed(3)}`}
              </p>
            </article>
          ))}
          {!moment.servers.length && <p class="note">The cloud trains on what vehicles uploaded; nothing goes back and forth.</p>}
        </div>
        {footage.sweep && <Sweep api={api} fail={fail} />}
        {footage.pictures.map((task) => <Shot key={task} api={api} task={task} fail={fail} />)}
      </main>
      <aside class="panel" aria-label="Ledger" tabindex={0}>
        <section>
          <h2>Ledger</h2>
          {LINKS.map((link) => {
            const part = run.budgets[link] ? moment.sent[link] / run.budgets[link] : 0;
            return (
              <div class="slider" key={link}>
                <p><b>{link}</b> {moment.sent[link].toFixed(1)} of {run.budgets[link]} MB</p>
                <div class="bar"><span class="yours" style={{ width: `${Math.min(100 * part, 100)}%` }} /></div>
              </div>
            );
          })}
          <p class="note">What a stage sent beside its rounds, its samples and labels, counts before the first of them.</p>
        </section>
        <section>
          <h2>Road sensors</h2>
          <ul class="facts">{run.placed.map((each) => <li>{each.region}: {each.poles.length ? `pole ${each.poles.join(", ")} covers ${each.covered} of ${each.errors} errors` : `no sensor; ${each.errors} errors`}</li>)}</ul>
        </section>
        <section>
          <h2>Findings</h2>
          {run.findings.slice(0, 4).map((each) => <p class="note"><b>{each.verdict}</b> {each.sentence}</p>)}
        </section>
      </aside>
    </div>
  );
}

function Scores({ run, at, best, onPick }: { run: RunInfo; at: number; best: number; onPick: (at: number) => void }) {
  const { moments } = run;
  const names = Object.keys(moments[moments.length - 1].scores);
  const values = moments.flatMap((each) => Object.values(each.scores));
  const narrow = matchMedia("(max-width: 820px)").matches;
  const [width, height, left, right, top, bottom] = narrow ? [400, 300, 38, 16, 18, 30] : [860, 300, 44, 130, 18, 30];
  const low = Math.floor(Math.min(...values) * 20) / 20;
  const high = Math.max(Math.ceil(Math.max(...values) * 20) / 20, low + 0.05);
  const x = (n: number) => left + ((width - left - right) * n) / Math.max(moments.length - 1, 1);
  const y = (score: number) => height - bottom - ((height - top - bottom) * (score - low)) / Math.max(high - low, 1e-9);
  const ends = names.map((name) => ({ name, y: y(moments[moments.length - 1].scores[name]) })).sort((a, b) => a.y - b.y);
  ends.forEach((end, n) => n && (end.y = Math.max(end.y, ends[n - 1].y + 16)));
  const below = Math.max((ends[ends.length - 1]?.y ?? 0) - (height - bottom - 8), 0);
  ends.forEach((end) => (end.y -= below));
  return (
    <svg class="curve scores" viewBox={`0 0 ${width} ${height}`} role="img" aria-label={`Validation scores by round: ${names.map((name) => `${name} from ${moments[0].scores[name]?.toFixed(3) ?? "?"} to ${moments[moments.length - 1].scores[name].toFixed(3)}`).join("; ")}`}>
      {Array.from({ length: Math.round((high - low) / 0.05) + 1 }, (_, n) => low + n * 0.05).map((score) => (
        <g class="grid"><line x1={left} x2={width - right} y1={y(score)} y2={y(score)} /><text x={left - 8} y={y(score)} dy=".35em" text-anchor="end">{score.toFixed(2)}</text></g>
      ))}
      <text class="tick" x={narrow ? 0 : width - right + 12} y={12}>validation score</text>
      <rect class="past" x={x(0)} width={Math.max(x(at) - x(0), 0)} y={top} height={height - top - bottom} />
      {best >= 0 && <text class="tick" x={Math.max(x(best), narrow ? 130 : 0)} y={12} text-anchor="middle">gained most</text>}
      {names.map((name, k) => (
        <g class={`line k${k % 6}`}>
          <path d={moments.flatMap((each, n) => (each.scores[name] === undefined ? [] : [`${x(n)} ${y(each.scores[name])}`])).map((point, n) => (n ? "L" : "M") + point).join("")} />
          {moments.map((each, n) => each.scores[name] !== undefined && <circle cx={x(n)} cy={y(each.scores[name])} r={n === at ? 6 : 3.2} />)}
          {narrow ? (
            <text x={width - right - 6} y={height - bottom - 12 - 18 * k} text-anchor="end">{name}</text>
          ) : (
            <text x={width - right + 12} y={ends.find((each) => each.name === name)!.y} dy=".35em">{name}</text>
          )}
        </g>
      ))}
      {moments.map((each, n) => (
        <g onClick={() => onPick(n)} class="moment">
          <rect x={x(n) - 14} width="28" y={top} height={height - top} />
          {(!narrow || n % 3 === 0 || n === at) && <text class={`tick${n === at ? " now" : ""}`} x={x(n)} y={height - 9} text-anchor="middle">{each.stage === "pretrain" ? "I" : `${each.stage === "edge" ? "II" : "III"}·${each.round}`}</text>}
        </g>
      ))}
    </svg>
  );
}
