/** What the page asks: a server, or in a saved page what was computed before. */
import type { SweepData } from "./scene/sweep";
import type { Best, Look, NewPole, Picture, Placing, Plan, RegionDrive, Saving, Stand, Start, Workspace } from "./types";

export interface Api {
  saved: boolean;
  start(): Promise<Start>;
  open(town: string): Promise<Workspace>;
  workspace(key: string): Promise<Workspace>;
  drop(file: File, workspace: string): Promise<Workspace>;
  dropRun(name: string, files: Record<string, string>): Promise<Start>;
  look(key: string, stand: Stand, range_m: number, sight: boolean): Promise<Look>;
  best(key: string, asked: Placing, limit: { count?: number; budget?: number }): Promise<Best>;
  curve(key: string, asked: Placing): Promise<Best[]>;
  newPoles(key: string, asked: Placing, kind: number, uncovered: number[]): Promise<NewPole[]>;
  files(key: string, asked: Placing): Promise<{ csv: string; geojson: string; yaml: string; command: string }>;
  plan(budgets: Budgets): Promise<Plan>;
  more(budgets: Budgets): Promise<{ savings?: Saving[] }>;
  drive(region: string): Promise<RegionDrive>;
  sweep(): Promise<SweepData>;
  errorSweep(key: string, row: number): Promise<SweepData>;
  picture(task: string): Promise<Picture>;
}
export type Budgets = { wireless_mb: number; wireline_mb: number; horizon_s: number | null };

export class Unreachable extends Error {}

const KEY = "flcav-planner-token";

/** Take the token out of the address, which is shared with others, into the memory of this tab. */
export function takeToken(): string {
  const given = /[#&]token=([^&]+)/.exec(location.hash);
  if (given) {
    sessionStorage.setItem(KEY, given[1]);
    history.replaceState(null, "", location.pathname + location.hash.replace(/&?token=[^&]+/, "").replace(/^#&/, "#"));
  }
  return sessionStorage.getItem(KEY) ?? "";
}

const ownSites = (asked: Placing) => asked.stands.filter((each) => each.pole === null).map((each) => [each.x, each.y]);

export function siteOf(asked: Placing, stand: Stand, poles: number): number {
  if (stand.pole !== null) return stand.pole;
  return poles + asked.stands.filter((each) => each.pole === null).findIndex((each) => each.id === stand.id);
}

export function makeLive(poles: () => number): Api {
  const token = takeToken();
  async function send<T>(path: string, body: BodyInit): Promise<T> {
    let answer: Response;
    try {
      answer = await fetch(path, {
        method: "POST",
        body,
        headers: { authorization: `Bearer ${token}`, "content-type": "application/json" },
      });
    } catch {
      throw new Unreachable("The planner does not answer: was it ended? Start it again, and open its new address.");
    }
    const value = await answer.json().catch(() => ({ error: `the planner answered ${answer.status}` }));
    if (!answer.ok) throw new Error(value.error ?? `the planner answered ${answer.status}`);
    return value as T;
  }
  const ask = <T>(name: string, body: object) => send<T>(`/api/${name}`, JSON.stringify(body));
  const question = (key: string, asked: Placing) => ({
    workspace: key,
    kinds: asked.kinds,
    own: ownSites(asked),
    line_of_sight: asked.sight,
    without: asked.without,
  });
  return {
    saved: false,
    start: () => ask("start", {}),
    open: (town) => ask("open", { town }),
    workspace: (key) => ask("workspace", { town: key }),
    drop: (file, workspace) =>
      send(`/api/drop?name=${encodeURIComponent(file.name)}&workspace=${encodeURIComponent(workspace)}`, file),
    dropRun: (name, files) => ask("drop-run", { name, files }),
    look: (key, stand, range_m, sight) =>
      ask("look", {
        workspace: key,
        pole: stand.pole,
        x: stand.pole === null ? stand.x : 0,
        y: stand.pole === null ? stand.y : 0,
        range_m,
        line_of_sight: sight,
      }),
    best: (key, asked, limit) => ask("best", { ...question(key, asked), ...limit }),
    curve: async (key, asked) => (await ask<{ steps: Best[] }>("curve", question(key, asked))).steps,
    newPoles: async (key, asked, kind, uncovered) =>
      (await ask<{ places: NewPole[] }>("new-poles", { ...question(key, asked), kind, uncovered })).places,
    files: (key, asked) =>
      ask("export", {
        ...question(key, asked),
        pairs: asked.stands.map((each) => [siteOf(asked, each, poles()), each.kind]),
      }),
    plan: (budgets) => ask("plan", budgets),
    more: (budgets) => ask("plan-more", budgets),
    drive: (name) => ask("drive", { name }),
    sweep: () => ask("sweep", {}),
    errorSweep: (key, row) => ask("error-sweep", { workspace: key, row }),
    picture: (name) => ask("picture", { name }),
  };
}

export type Saved = { start: Start; workspace: Workspace; looks: Record<string, Look>; curve: Best[]; command: string };

/** The answers of a page that was written by `--html`: poles only, and the optima by number of sensors. */
export function makeSaved(saved: Saved): Api {
  const none = () => Promise.reject(new Error("a saved page cannot compute this: flcav planner can"));
  return {
    saved: true,
    start: async () => saved.start,
    open: async () => saved.workspace,
    workspace: async () => saved.workspace,
    drop: none,
    dropRun: none,
    look: async (_key, stand, range_m) => {
      const kind = saved.start.kinds.findIndex((each) => each.range_m === range_m);
      return saved.looks[`${stand.pole} ${kind}`] ?? { area: "", covered: [], z: 0 };
    },
    best: async (_key, _asked, { count, budget }) => {
      const fit = saved.curve.filter((each) => (count ? each.pairs.length <= count : each.cost <= (budget ?? 0) + 1e-9));
      if (!fit.length) throw new Error("no optimum was computed for so little");
      return fit[fit.length - 1];
    },
    curve: async () => saved.curve,
    newPoles: none,
    files: async () => ({ csv: "", geojson: "", yaml: "", command: saved.command }),
    plan: none,
    more: none,
    drive: none,
    sweep: none,
    errorSweep: none,
    picture: none,
  };
}
