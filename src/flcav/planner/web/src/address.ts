/** The state of the page in its address, after the #: less than 2 kB, so that it can be sent to others. */
import type { Kind, Placing, Stand } from "./types";

export type Tab = "place" | "plan" | "replay";
export type Played = { region: string; moment: number }; // what is replayed: a region's map, and the number of a moment
export type Shared = { town: string; tab: Tab | null; placing: Partial<Placing>; budgets: number[]; solid: boolean; played: Played };

const enc = encodeURIComponent;
const short = (value: number) => String(Math.round(value * 100) / 100);

export function writeAddress(town: string, tab: Tab, placing: Placing, budgets: number[], solid: boolean, played: Played): string {
  const parts = [];
  if (town) parts.push(`t=${enc(town)}`);
  if (tab !== "place") parts.push(`tab=${tab}`);
  else if (!town) return "";
  if (town) {
    parts.push(`k=${placing.kinds.map((each) => [enc(each.name), short(each.range_m), short(each.cost)].join(",")).join(";")}`);
    if (placing.stands.length)
      parts.push(
        `s=${placing.stands
          .map((each) => (each.pole === null ? `${short(each.x)},${short(each.y)},${each.kind}` : `${each.pole},${each.kind}`))
          .join(";")}`,
      );
    if (!placing.sight) parts.push("sight=0");
    if (solid) parts.push("v=3d");
    if (placing.without.length) parts.push(`w=${placing.without.map(enc).join(";")}`);
  }
  if (tab === "replay") parts.push(...(played.region ? [`r=${enc(played.region)}`] : []), `m=${played.moment}`);
  if (budgets.length) parts.push(`b=${budgets.map(short).join(",")}`);
  return parts.join("&");
}

export function readAddress(hash: string): Shared {
  const fields = new Map(
    hash
      .replace(/^#/, "")
      .split("&")
      .map((part) => [part.slice(0, part.indexOf("=")), part.slice(part.indexOf("=") + 1)] as [string, string]),
  );
  const placing: Partial<Placing> = {};
  const text = (value: string) => {
    try {
      return decodeURIComponent(value);
    } catch {
      return value;
    }
  };
  const kinds = fields.get("k")?.split(";").map((part): Kind => {
    const [name, range, cost] = part.split(",");
    return { name: text(name), range_m: Number(range), cost: Number(cost) };
  });
  if (kinds?.every((each) => each.name && each.range_m >= 1 && each.range_m <= 2000 && each.cost >= 0)) placing.kinds = kinds;
  const stands = fields.get("s")?.split(";").map((part, id): Stand => {
    const numbers = part.split(",").map(Number);
    return numbers.length === 3
      ? { id: id + 1, pole: null, x: numbers[0], y: numbers[1], kind: numbers[2] }
      : { id: id + 1, pole: numbers[0], x: 0, y: 0, kind: numbers[1] };
  });
  if (stands) placing.stands = stands.filter((each) => [each.pole ?? 0, each.x, each.y, each.kind].every(Number.isFinite));
  if (fields.get("sight") === "0") placing.sight = false;
  const without = fields.get("w");
  if (without) placing.without = without.split(";").map(text);
  const tab = fields.get("tab");
  const budgets = (fields.get("b") ?? "").split(",").map(Number).filter((each) => each > 0);
  const moment = Number(fields.get("m") ?? 0);
  const played = { region: text(fields.get("r") ?? ""), moment: Number.isInteger(moment) && moment > 0 ? moment : 0 };
  return { played, town: text(fields.get("t") ?? ""), tab: tab === "place" || tab === "plan" || tab === "replay" ? tab : null, placing, budgets, solid: fields.get("v") === "3d" };
}
