/** Parts of the tab Place: the bar of coverage, the legend, the command that does the same. */
import { useEffect, useState } from "preact/hooks";
import type { Api } from "./api";
import { wordOf } from "./errors";
import type { Placing, Workspace } from "./types";

export function Command({ api, space, placing, say, fail }: { api: Api; space: Workspace; placing: Placing; say: (text: string) => void; fail: (error: unknown) => void }) {
  const [text, setText] = useState("");
  useEffect(() => setText(""), [JSON.stringify(placing), space.key]);
  if (!space.errors.length) return null;
  return text ? (
    <>
      <pre tabindex={0} aria-label="The command that finds the optimum">{text}</pre>
      <button type="button" class="quiet" onClick={() => navigator.clipboard.writeText(text).then(() => say("The command is copied"), fail)}>Copy it</button>
    </>
  ) : (
    <button type="button" class="quiet" onClick={() => api.files(space.key, placing).then((files) => setText(files.command)).catch(fail)}>
      The command that does the same
    </button>
  );
}

export function Bar({ total, covered, best, beyond }: { total: number; covered: number; best: number | null; beyond: number | null }) {
  const share = (value: number) => `${(100 * value) / Math.max(total, 1)}%`;
  return (
    <div class="bar" aria-hidden="true">
      <span class="yours" style={{ width: share(covered) }} />
      <span class="more" style={{ width: share(Math.max((best ?? covered) - covered, 0)) }} />
      {beyond !== null && <span class="beyond" style={{ width: share(beyond) }} />}
    </div>
  );
}

export function Legend({ space, covered, solid }: { space: Workspace; covered: boolean; solid: boolean }) {
  const kinds = [...new Set(space.errors.map((each) => each.kind))].sort((one, other) => Number(one === "false_positive") - Number(other === "false_positive"));
  const crossed = (kind: string) => kind === "false_positive" && !solid;
  const mark = (kind: string) => {
    if (kind === "false_positive") return solid ? "M-4 -4h8v8h-8Z" : "M-4 -4l8 8m0 -8l-8 8";
    return kind === "final_error" && !solid ? "M0 -5l5 8h-10Z" : "M-4 0a4 4 0 1 0 8 0a4 4 0 1 0 -8 0";
  };
  const Mark = ({ kind, seen }: { kind: string; seen?: boolean }) => (
    <svg viewBox="-7 -7 14 14" aria-hidden="true"><path class={`e ${kind}${seen ? " seen" : ""}${solid ? " solid" : ""}`} d={mark(kind)} stroke-width={crossed(kind) ? 2 : 1} /></svg>
  );
  return (
    <ul class="legend" aria-label="Legend">
      {kinds.map((kind) => <li><Mark kind={kind} />{wordOf(kind)}</li>)}
      {kinds.length > 0 && covered && <li><Mark kind={kinds[0]} seen />covered</li>}
      <li><svg viewBox="-7 -7 14 14" aria-hidden="true"><g class="pole"><circle r="5" /></g></svg>candidate pole</li>
      {covered && <li><svg viewBox="-7 -7 14 14" aria-hidden="true"><g class="stand k0"><circle r="5.5" /></g></svg>sensor, and what it sees</li>}
    </ul>
  );
}
