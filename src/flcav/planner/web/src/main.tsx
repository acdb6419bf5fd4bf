import { render } from "preact";
import { useCallback, useEffect, useMemo, useRef, useState } from "preact/hooks";
import { readAddress, writeAddress, type Tab } from "./address";
import { makeLive, makeSaved, Unreachable, type Budgets, type Saved } from "./api";
import { chosenFolder, packFolder, readFolder, type Folder } from "./folder";
import { Place } from "./place";
import { PlanTab } from "./plan";
import { Replay } from "./replay";
import type { Card, Kind, Placing, Point, Start, Workspace } from "./types";

const TABS: Record<Tab, string> = { place: "Place", plan: "Plan", replay: "Replay" };

function App() {
  const poles = useRef(0);
  const api = useMemo(() => {
    const saved = document.getElementById("saved")?.textContent;
    return saved ? makeSaved(JSON.parse(saved) as Saved) : makeLive(() => poles.current);
  }, []);
  const shared = useMemo(() => readAddress(location.hash), []);
  const [start, setStart] = useState<Start | null>(null);
  const [space, setSpace] = useState<Workspace | null>(null);
  const [{ placing, past }, setHistory] = useState<{ placing: Placing; past: Placing[] }>({
    placing: { kinds: [], stands: [], sight: true, without: [] },
    past: [],
  });
  const [tab, setTab] = useState<Tab>(shared.tab ?? "place");
  const [solid, setSolid] = useState(shared.solid);
  const [played, setPlayed] = useState(shared.played);
  const [budgets, setBudgets] = useState<Budgets | null>(null);
  const [busy, setBusy] = useState("");
  const [problem, setProblem] = useState("");
  const [notice, setNotice] = useState("");
  const [lost, setLost] = useState(false);
  const [said, say] = useState("");

  const fail = useCallback((error: unknown) => {
    if (error instanceof Unreachable) setLost(true);
    setProblem(error instanceof Error ? error.message : String(error));
  }, []);

  /** Take a workspace, and of a shared state what it has: sensors on poles that are not there are left out. */
  const take = useCallback((found: Workspace, kinds: Kind[], state: Partial<Placing> = {}) => {
    poles.current = found.poles.length;
    const own = state.kinds ?? kinds;
    setSpace(found);
    const stands = (state.stands ?? []).filter(
      (each) => (each.pole === null || (Number.isInteger(each.pole) && each.pole >= 0 && each.pole < found.poles.length)) && own[each.kind],
    );
    setHistory({ placing: { kinds: own, stands, sight: state.sight ?? true, without: state.without ?? [] }, past: [] });
  }, []);

  useEffect(() => {
    (async () => {
      const found = await api.start();
      setStart(found);
      if (found.problem) {
        const [wireless_mb, wireline_mb, horizon_s] = shared.budgets;
        const { problem } = found;
        setBudgets({ wireless_mb: wireless_mb ?? problem.wireless_mb, wireline_mb: wireline_mb ?? problem.wireline_mb, horizon_s: horizon_s ?? problem.horizon_s });
        setTab("plan");
      }
      if (found.run && !shared.tab && !shared.town) setTab("replay");
      const wanted = shared.town || found.first;
      if (!wanted || ((found.problem || found.run) && !found.first)) return;
      setBusy(`Opening ${wanted} …`);
      try {
        take(await api.workspace(wanted), found.kinds, shared.placing);
      } catch {
        const town = wanted.split("~")[0];
        take(await (found.first ? api.workspace(found.first) : api.open(town)), found.kinds, shared.placing);
        if (wanted.includes("~")) setProblem(`The link is about the table ${wanted.split("~")[1]}, which is not open here: drop it on the map.`);
      }
      setBusy("");
    })().catch((error) => [setBusy(""), fail(error)]);
  }, []);

  const setPlacing = useCallback((next: Placing) => setHistory((held) => ({ placing: next, past: [...held.past.slice(-99), held.placing] })), []);
  const goBack = () => setHistory(({ placing, past }) => ({ placing: past[past.length - 1] ?? placing, past: past.slice(0, -1) }));
  const undo = past.length ? goBack : null;

  useEffect(() => {
    if (!start || api.saved) return;
    const numbers = budgets && tab === "plan" ? [budgets.wireless_mb, budgets.wireline_mb, ...(budgets.horizon_s ? [budgets.horizon_s] : [])] : [];
    const address = writeAddress(space?.key ?? "", tab, placing, numbers, solid, played);
    if (address.length < 2000) history.replaceState(null, "", `${location.pathname}#${address}`);
  }, [space, tab, placing, budgets, start, solid, played]);

  const open = (name: string) => {
    setBusy(`Opening ${name} …`);
    api.open(name).then((found) => [take(found, start!.kinds), setTab("place")]).catch(fail).finally(() => setBusy(""));
  };
  const drop = (file: File | undefined) => {
    if (!file || api.saved) return;
    setProblem("");
    setBusy(file.name.endsWith(".xodr") ? `Importing ${file.name} …` : `Reading ${file.name} …`);
    api.drop(file, space?.key ?? "").then((found) => {
      const sameTown = space && found.key.split("~")[0] === space.key.split("~")[0];
      take(found, start!.kinds, sameTown ? { ...placing, without: [] } : {});
      say(`${file.name}: ${found.errors.length} ${found.noun}s`);
    }).catch(fail).finally(() => setBusy(""));
  };
  const dropRun = (folder: Promise<Folder>) => {
    if (api.saved) return;
    setProblem("");
    setBusy("Reading the run …");
    folder
      .then(async (found) => api.dropRun(found.name, await packFolder(found)))
      .then((found) => {
        setStart(found);
        setPlayed({ region: "", moment: 0 });
        setTab("replay");
        setNotice(`Rounds and errors of ${found.run!.name} were read. Its drives, sweeps and pictures are shown by: flcav planner ${found.run!.name}`);
        if (!space && found.first) return api.workspace(found.first).then((at) => take(at, found.kinds));
      })
      .catch(fail)
      .finally(() => setBusy(""));
  };
  useEffect(() => {
    const over = (event: DragEvent) => event.preventDefault();
    const dropped = (event: DragEvent) => {
      event.preventDefault();
      const entry = event.dataTransfer?.items[0]?.webkitGetAsEntry();
      if (entry?.isDirectory) dropRun(readFolder(entry as FileSystemDirectoryEntry));
      else drop(event.dataTransfer?.files[0]);
    };
    window.addEventListener("dragover", over);
    window.addEventListener("drop", dropped);
    return () => [window.removeEventListener("dragover", over), window.removeEventListener("drop", dropped)] as unknown as void;
  });

  const tabs = (["place", "plan", "replay"] as Tab[]).filter((each) => (each === "place" ? space : each === "plan" ? start?.problem : start?.run));
  return (
    <>
      <header>
        <span class="mark"><b>flcav</b> planner</span>
        {tabs.length > 1 && <nav>{tabs.map((each) => <button type="button" aria-current={tab === each ? "page" : undefined} onClick={() => setTab(each)}>{TABS[each]}</button>)}</nav>}
        {start && start.spaces.length > 1 && tab === "place" && (
          <select aria-label="Region" value={space?.key} onChange={(event) => api.workspace(event.currentTarget.value).then((found) => take(found, placing.kinds)).catch(fail)}>
            {start.spaces.map((key) => <option>{key}</option>)}
          </select>
        )}
        {space && tab === "place" && <span class="where"><b>{space.map.name}</b>{space.table && <span> {space.table}</span>}</span>}
        {!api.saved && space && tab === "place" && (
          <label class="file">
            <input type="file" accept=".csv,.parquet,.xodr" onChange={(event) => [drop(event.currentTarget.files?.[0]), (event.currentTarget.value = "")]} />
            <span>Open errors or a map …</span>
          </label>
        )}
        {api.saved && <span class="stamp">saved page · optima precomputed</span>}
      </header>
      {problem && (
        <div class={`alert bar-alert${lost ? " lost" : ""}`} role="alert">
          <span>{problem}</span>
          {lost ? <button type="button" onClick={() => location.reload()}>Try again</button> : <button type="button" aria-label="Close the message" onClick={() => setProblem("")}>×</button>}
        </div>
      )}
      {notice && tab === "replay" && (
        <div class="alert bar-alert" role="status"><span>{notice}</span><button type="button" aria-label="Close the message" onClick={() => setNotice("")}>×</button></div>
      )}
      {busy && <div class="busy" role="status"><i aria-hidden="true" />{busy}</div>}
      {tab === "place" && space && placing.kinds.length > 0 && <Place {...{ api, space, placing, setPlacing, undo, solid, setSolid, say, fail }} />}
      {tab === "plan" && start?.problem && budgets && <PlanTab {...{ api, problem: start.problem, budgets, setBudgets, say, fail }} />}
      {tab === "replay" && start?.run && <Replay key={start.run.name} {...{ api, played, setPlayed, say, fail }} run={start.run} />}
      {start && !space && !start.problem && !start.run && !busy && <Welcome cards={start.towns} onOpen={open} onFile={drop} onFolder={dropRun} />}
      <p class="said" role="status" aria-live="polite">{said}</p>
    </>
  );
}

type WelcomeProps = { cards: Card[]; onOpen: (name: string) => void; onFile: (file: File | undefined) => void; onFolder: (folder: Promise<Folder>) => void };

function Welcome({ cards, onOpen, onFile, onFolder }: WelcomeProps) {
  const path = (points: Point[]) => `M${points.map(([x, y]) => `${x} ${y}`).join("L")}Z`;
  return (
    <main class="welcome">
      <h1>Where should sensors stand?</h1>
      <p>Choose a town, then drop a table of errors or accidents on its map. Or bring your own: an OpenDRIVE map, or the folder of a finished run, which is replayed.</p>
      <div class="row">
        <label class="file inline"><input type="file" accept=".xodr" onChange={(event) => onFile(event.currentTarget.files?.[0])} /><span>Open a map (.xodr) …</span></label>
        <label class="file inline"><input type="file" {...{ webkitdirectory: "" }} onChange={(event) => event.currentTarget.files?.length && onFolder(Promise.resolve(chosenFolder(event.currentTarget.files)))} /><span>Open a run's folder …</span></label>
      </div>
      <div class="towns">
        {cards.map((card) => {
          const [x0, y0, x1, y1] = card.bounds;
          return (
            <button type="button" class="card" onClick={() => onOpen(card.name)}>
              <svg viewBox={`${x0} ${-y1} ${x1 - x0} ${y1 - y0}`} aria-hidden="true"><path transform="scale(1,-1)" d={card.roads.map(path).join("")} /></svg>
              <b>{card.name}</b>
              <span>{card.said}</span>
              <small>{card.told}</small>
            </button>
          );
        })}
      </div>
    </main>
  );
}

render(<App />, document.getElementById("app")!);
