/** The tab Plan: sliders over both uplink budgets and the time; samples, rounds and accuracies of every task. */
import { useEffect, useState } from "preact/hooks";
import type { Api, Budgets } from "./api";
import type { Plan, ProblemInfo, Saving, TaskPlan } from "./types";

type Props = { api: Api; problem: ProblemInfo; budgets: Budgets; setBudgets: (next: Budgets) => void; say: (text: string) => void; fail: (error: unknown) => void };
const digits = (value: number) => value.toPrecision(2);
/** As many digits, from two on, as tell two numbers apart; four at most. */
const apart = (one: number, other: number | undefined) => [2, 3].find((each) => other === undefined || one.toPrecision(each) !== other.toPrecision(each)) ?? 4;
const percent = (value: number) => `${Math.round(value * 1000) / 10} %`;

export function PlanTab({ api, problem, budgets, setBudgets, say, fail }: Props) {
  const [plan, setPlan] = useState<Plan | null>(null);
  const [planFor, setPlanFor] = useState("");
  const [savings, setSavings] = useState<Saving[] | null>(null);
  const asked = JSON.stringify(budgets);
  useEffect(() => {
    let current = true;
    const soon = setTimeout(() => {
      performance.mark("plan-asked");
      api.plan(budgets).then((found) => {
        performance.measure("plan", "plan-asked");
        if (!current) return;
        setPlan(found);
        setPlanFor(asked);
        say(found.infeasible ? found.infeasible : `${problem.measure} ${digits(found.objective)}`);
      }).catch(fail);
    }, 60);
    setSavings(null);
    const later = setTimeout(() => api.more(budgets).then((found) => current && setSavings(found.savings ?? [])).catch(fail), 400);
    return () => [clearTimeout(soon), clearTimeout(later), (current = false)];
  }, [asked]);
  const sliders: [string, keyof Budgets, string, number][] = [
    ["Wireless", "wireless_mb", "MB", problem.wireless_mb],
    ["Wireline", "wireline_mb", "MB", problem.wireline_mb],
  ];
  if (problem.horizon_s !== null) sliders.push(["Time of each vehicle", "horizon_s", "s", problem.horizon_s]);
  const feasible = plan && !plan.infeasible ? plan : null;
  const told = apart(feasible?.objective ?? 0, feasible?.equal?.objective);
  return (
    <div class="plan">
      <aside class="panel" aria-label="Budgets">
        <section>
          <h1>{problem.name}</h1>
          <h2>What may go up</h2>
          {sliders.map(([name, field, unit, given]) => (
            <Slider key={field} {...{ name, unit, given }} value={budgets[field] ?? given} used={feasible && field !== "horizon_s" ? feasible.used_mb[field === "wireless_mb" ? 0 : 1] : (feasible?.busy_s ?? null)} onChange={(value) => setBudgets({ ...budgets, [field]: value })} />
          ))}
          <button type="button" class="quiet" onClick={() => setBudgets({ wireless_mb: problem.wireless_mb, wireline_mb: problem.wireline_mb, horizon_s: problem.horizon_s })}>Back to the problem's</button>
        </section>
        <section>
          <h2>What more buys</h2>
          {!savings ? <p class="wait">Solving anew with more …</p> : (
            <ul class="facts">
              {savings.map((each) => (
                <li>
                  {percent(each.added)} more {each.link} (+{Math.round(each.added_mb)} MB): {each.saved ? <><b>{digits(each.saved)}</b> {problem.more_is_better ? "more" : "less"} {problem.measure}</> : <b>nothing</b>}
                </li>
              ))}
            </ul>
          )}
        </section>
      </aside>
      <main class="sheet" aria-busy={planFor !== asked}>
        {!plan && <p class="wait">Planning …</p>}
        {plan?.infeasible && <div class="alert"><h2>No plan fits</h2><p>{plan.infeasible}</p></div>}
        {feasible && (
          <>
            <p class="big"><strong id="objective">{feasible.objective.toPrecision(told)}</strong> {problem.measure}</p>
            <p class="note">{problem.measure[0].toUpperCase() + problem.measure.slice(1)}: {feasible.said} {feasible.gap === null ? "There is no certificate." : `Proven within ${percent(feasible.gap)} for the fitted curves.`}
              {feasible.equal && ` Equal shares of the stages: ${feasible.equal.objective.toPrecision(told)}.`}</p>
            <div class="cards">
              {feasible.tasks.map((task, n) => <TaskCard task={task} equal={feasible.equal?.tasks[n] ?? null} warnings={feasible.warnings.filter((each) => each.includes(`'${task.name}'`))} />)}
            </div>
            {feasible.warnings.filter((each) => !feasible.tasks.some((task) => each.includes(`'${task.name}'`))).map((each) => <p class="warn">{each}</p>)}
          </>
        )}
      </main>
    </div>
  );
}

function Slider({ name, unit, given, value, used, onChange }: { name: string; unit: string; given: number; value: number; used: number | null; onChange: (value: number) => void }) {
  // From a tenth to ten times what the problem gives, in equal steps of the logarithm.
  const at = Math.log10(value / given);
  return (
    <div class="slider">
      <label>
        <span>{name}</span>
        <input type="number" min={given / 1000} step="any" value={Math.round(value * 100) / 100} aria-label={`${name} in ${unit}`} onChange={(event) => Number(event.currentTarget.value) > 0 && onChange(Number(event.currentTarget.value))} /> {unit}
      </label>
      <input type="range" min={-1} max={1} step={0.01} value={at} aria-label={`${name}: slider`} aria-valuetext={`${Math.round(value)} ${unit}`} onInput={(event) => onChange(Number((given * 10 ** Number(event.currentTarget.value)).toPrecision(3)))} />
      {used !== null && <div class="bar" title={`${used.toFixed(1)} used`}><span class="yours" style={{ width: `${Math.min((100 * used) / value, 100)}%` }} /></div>}
      {used !== null && <small>{used.toFixed(1)} {unit} used</small>}
    </div>
  );
}

function TaskCard({ task, equal, warnings }: { task: TaskPlan; equal: TaskPlan | null; warnings: string[] }) {
  const rows: [string, keyof TaskPlan][] = [["samples", "samples"], ["edge rounds", "edge_rounds"], ["cloud rounds", "cloud_rounds"]];
  const share = (value: number) => `${100 * Math.min(Math.max(value, 0), 1)}%`;
  return (
    <article class="task">
      <h2>{task.name}</h2>
      <p class="mid"><strong>{task.told.split(" ")[0]}</strong> predicted accuracy</p>
      <div class="gauge" aria-hidden="true">
        {task.low !== null && <span class="band" style={{ left: share(task.low), width: share((task.high ?? 1) - task.low) }} />}
        <span class="dot" style={{ left: share(task.accuracy) }} />
        {equal && <span class="ghost" style={{ left: share(equal.accuracy) }} />}
      </div>
      {task.low !== null && <p class="note">band: {task.told.slice(task.told.indexOf("("))}</p>}
      <table>
        <thead><tr><td /><th>plan</th>{equal && <th>equal shares</th>}</tr></thead>
        <tbody>
          {rows.map(([name, field]) => <tr><th scope="row">{name}</th><td>{String(task[field])}</td>{equal && <td>{String(equal[field])}</td>}</tr>)}
          <tr><th scope="row">accuracy</th><td>{task.told.split(" ")[0]}</td>{equal && <td>{equal.told.split(" ")[0]}</td>}</tr>
          <tr><th scope="row">wireless MB</th><td>{task.mb[0].toFixed(0)}</td>{equal && <td>{equal.mb[0].toFixed(0)}</td>}</tr>
          <tr><th scope="row">wireline MB</th><td>{task.mb[1].toFixed(0)}</td>{equal && <td>{equal.mb[1].toFixed(0)}</td>}</tr>
        </tbody>
      </table>
      {warnings.map((each) => <p class="warn">{each}</p>)}
    </article>
  );
}
