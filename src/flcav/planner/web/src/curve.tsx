/** Coverage against cost, or against the number of sensors: the proven optima, and what is placed. */
import type { Best } from "./types";

type Props = {
  steps: Best[];
  priced: boolean;
  even: boolean; // whether all errors weigh 1
  total: number;
  yours: { x: number; y: number } | null;
  onPick: (step: Best) => void;
};

export function Curve({ steps, priced, even, total, yours, onPick }: Props) {
  const [width, height, left, bottom, top, right] = [336, 168, 34, 24, 12, 10];
  const x = (step: Best) => (priced ? step.cost : step.pairs.length);
  const y = (step: Best) => (even ? step.covered : step.weight);
  const most = Math.max(...steps.map(x), yours?.x ?? 0) * 1.04;
  const high = Math.max(...steps.map((each) => each.bound), yours?.y ?? 0, 1) * 1.08;
  const atX = (value: number) => left + ((width - left - right) * value) / most;
  const atY = (value: number) => height - bottom - ((height - bottom - top) * value) / high;
  const line = steps.reduce((path, step, n) => {
    const [px, py] = [atX(x(step)), atY(y(step))];
    return n ? `${path}H${px}V${py}` : `M${atX(0)} ${atY(0)}H${px}V${py}`;
  }, "");
  const ticks = (end: number, count: number) => {
    const rough = end / count / 1.6;
    const power = 10 ** Math.floor(Math.log10(rough));
    const step = Math.max([1, 2, 5, 10].find((each) => each * power >= rough)! * power, priced ? 0 : 1);
    return Array.from({ length: Math.floor(end / step) + 1 }, (_, n) => Math.round(n * step * 1e6) / 1e6);
  };
  return (
    <svg class="curve" viewBox={`0 0 ${width} ${height}`} role="group" aria-label="Optima by what they cost">
      {ticks(high, 4).map((value) => (
        <g class="grid">
          <line x1={left} x2={width - right} y1={atY(value)} y2={atY(value)} />
          <text x={left - 6} y={atY(value)} dy=".35em" text-anchor="end">{value}</text>
        </g>
      ))}
      {ticks(most, 6).map((value) => <text class="tick" x={atX(value)} y={height - 8} text-anchor="middle">{value}</text>)}
      <text class="tick" x={width - right} y={height - bottom - 5} text-anchor="end">{priced ? "cost" : "sensors"}</text>
      <path class="steps" d={`${line}H${width - right}`} />
      {steps.map((step) => (
        <g
          class={step.optimal ? "step" : "step open"}
          role="button"
          tabindex={0}
          aria-label={`${priced ? `cost ${x(step)}` : `${x(step)} sensors`}: ${y(step)} of ${total}${step.optimal ? ", proven" : `, at most ${step.bound}`}`}
          onClick={() => onPick(step)}
          onKeyDown={(event) => event.key === "Enter" && onPick(step)}
        >
          {!step.optimal && <line x1={atX(x(step))} x2={atX(x(step))} y1={atY(y(step))} y2={atY(step.bound)} />}
          <circle class="hit" cx={atX(x(step))} cy={atY(y(step))} r="11" />
          <circle cx={atX(x(step))} cy={atY(y(step))} r="3.6" />
        </g>
      ))}
      {yours && (
        <g class="yours">
          <circle cx={atX(yours.x)} cy={atY(yours.y)} r="6.5" />
          <text x={atX(yours.x)} y={atY(yours.y) + 19} text-anchor={atX(yours.x) > width - 60 ? "end" : "middle"}>yours {Math.round(yours.y * 100) / 100}</text>
        </g>
      )}
    </svg>
  );
}
