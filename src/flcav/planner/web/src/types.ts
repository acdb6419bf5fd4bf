export type Point = [number, number];
export type Kind = { name: string; range_m: number; cost: number };
export type Pole = { id: string; at: [number, number, number]; cost: number; street: string | null };
export type Wrong = {
  at: [number, number, number];
  weight: number;
  kind: string;
  class?: string;
  returns?: number;
  occlusion?: number;
  scene?: string;
  track?: string;
};
export type TownMap = {
  name: string;
  said: string;
  bounds: [number, number, number, number];
  roads: Point[][];
  sidewalks: Point[][];
  houses: Point[][];
  trees: [number, number, number][];
  streets: { name: string; line: Point[] }[];
};
export type Workspace = {
  key: string;
  map: TownMap;
  poles: Pole[];
  errors: Wrong[];
  noun: string;
  table: string;
  notes: string[];
  traffic: number;
};
export type Look = { area: string; covered: number[]; z: number };
export type Best = {
  pairs: [number, number][];
  covered: number;
  weight: number;
  bound: number;
  optimal: boolean;
  cost: number;
  beyond: number;
  errors: number;
};
export type NewPole = {
  site: { x: number; y: number; street: string | null };
  gain: number;
  errors: number;
};
export type Card = { name: string; said: string; told: string; bounds: [number, number, number, number]; roads: Point[][] };
export type ProblemInfo = {
  name: string;
  wireless_mb: number;
  wireline_mb: number;
  horizon_s: number | null;
  measure: string;
  more_is_better: boolean;
  tasks: string[];
};
export type TaskPlan = {
  name: string;
  samples: number;
  edge_rounds: number;
  cloud_rounds: number;
  accuracy: number;
  low: number | null;
  high: number | null;
  told: string;
  mb: [number, number];
};
export type Plan = {
  infeasible?: string;
  objective: number;
  said: string;
  gap: number | null;
  status: string;
  used_mb: [number, number];
  busy_s: number | null;
  warnings: string[];
  tasks: TaskPlan[];
  equal: { objective: number; note: string | null; tasks: TaskPlan[] } | null;
};
export type Saving = { link: string; added: number; added_mb: number; objective: number; gap: number | null; saved: number };
export type RunRound = {
  stage: string;
  task: string;
  server: string;
  round: number;
  up_mb: number;
  down_mb: number;
  loss: number | null;
  clients: number;
  failed: number;
};
export type Watched = { stage: string; task: string; region: string; frames: number; rounds: { round: number; score: number }[] };
export type RunInfo = {
  name: string;
  arm: string;
  budgets: { wireless: number; wireline: number };
  spent: { stage: string; task: string; link: string; mb: number }[];
  rounds: RunRound[];
  watched: Watched[];
  placed: { region: string; chosen: number[]; errors: number; covered: number; range_m: number }[];
  findings: { sentence: string; verdict: string; question: string; place: string }[];
  measure: string;
};
export type Start = {
  first: string | null;
  kinds: Kind[];
  towns: Card[];
  problem: ProblemInfo | null;
  run: RunInfo | null;
};
/** A sensor: on a pole, or at a place of one's own (pole null). */
export type Stand = { id: number; pole: number | null; x: number; y: number; kind: number };
export type Placing = { kinds: Kind[]; stands: Stand[]; sight: boolean; without: string[] };
