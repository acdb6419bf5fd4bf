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
  distance_m?: number; // from the vehicle that made it
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
  heights: number[]; // of the houses [m]
  trees: [number, number, number, number][]; // x, y, radius, height [m]
  relief: { columns: number; rows: number; z: number[] } | null; // heights of the ground over the bounds, rows from the south [m]
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
  sweeps?: boolean; // whether the sweeps in which errors were made can be asked for
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
export type Moment = {
  stage: string;
  round: number;
  told: string;
  servers: { server: string; task: string; clients: string[]; failed: number; loss: number | null; up_mb: number; down_mb: number }[];
  sent: Record<"wireless" | "wireline", number>;
  scores: Record<string, number>;
};
export type RunInfo = {
  name: string;
  arm: string;
  moments: Moment[];
  budgets: Record<"wireless" | "wireline", number>;
  used: Record<"wireless" | "wireline", number>;
  frames: number;
  findings: { verdict: string; sentence: string }[];
  placed: { region: string; poles: number[]; covered: number; errors: number }[];
  footage: { regions: string[]; sweep: boolean; pictures: string[] };
};
export type Pose = [number, number, number, number]; // x, y [m], yaw [rad], speed [m/s]
export type Drive = { times: number[]; users: { name: string; walks: boolean; size: [number, number]; path: (Pose | null)[] }[] };
export type RegionDrive = {
  map: TownMap;
  poles: [number, number, number][];
  range_m: number;
  errors: { at: Point; kind: string; scene: number; when: number }[];
  all: number; // errors that were registered, in scenes that are not played as well
  registry: Drive[];
  edge: Drive[];
};
export type Picture = {
  picture: string;
  width: number;
  height: number;
  region: string;
  labels: [number, number, number, number, string][];
  found: { title: string; said: string; boxes: [number, number, number, number, string, number][] }[];
};
export type Start = {
  first: string | null;
  kinds: Kind[];
  towns: Card[];
  problem: ProblemInfo | null;
  run: RunInfo | null;
  spaces: string[];
};
/** A sensor: on a pole, or at a place of one's own (pole null). */
export type Stand = { id: number; pole: number | null; x: number; y: number; kind: number };
export type Placing = { kinds: Kind[]; stands: Stand[]; sight: boolean; without: string[] };
