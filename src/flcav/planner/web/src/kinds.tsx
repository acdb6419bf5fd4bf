/** The kinds of sensors: chips to drag or choose, with range and price. */
import type { Kind, Placing } from "./types";

type Props = {
  placing: Placing;
  setPlacing: (next: Placing) => void;
  kind: number;
  setKind: (kind: number) => void;
  priced: boolean;
  range: (kind: number, by: number) => void;
  setKindField: (kind: number, fields: Partial<Kind>) => void;
  setCarried: (kind: number) => void;
  fixed: boolean;
};

export const number = (value: number) => String(Math.round(value * 100) / 100);

export function KindsSection({ placing, setPlacing, kind, setKind, priced, range, setKindField, setCarried, fixed }: Props) {
  const { kinds } = placing;
  return (
    <section>
      <h2>Kinds of sensors</h2>
      <div class="kinds">
        {kinds.map((each, n) => (
          <div class={`kind${n === kind ? " on" : ""}`} key={n}>
            <button
              type="button"
              class={`chip k${n % 6}`}
              aria-pressed={n === kind}
              title="Drag it onto the map, or choose it for the poles you press"
              onClick={() => setKind(n)}
              onPointerDown={(event) => {
                if (event.pointerType === "touch") return;
                setKind(n);
                const start = [event.clientX, event.clientY];
                const away = (moved: PointerEvent) => {
                  if (Math.hypot(moved.clientX - start[0], moved.clientY - start[1]) < 5) return;
                  end();
                  setCarried(n);
                };
                const end = () => [window.removeEventListener("pointermove", away), window.removeEventListener("pointerup", end)];
                window.addEventListener("pointermove", away);
                window.addEventListener("pointerup", end);
              }}
            >
              <i aria-hidden="true" /> {each.name}
            </button>
            {fixed ? (
              <span class="fixed">{each.range_m} m{priced ? ` · ${number(each.cost)}` : ""}</span>
            ) : (
              <>
                <label>
                  <span>range</span>
                  <input type="number" min={1} max={2000} step={1} value={each.range_m} aria-label={`Range of ${each.name} in metres`} onChange={(event) => range(n, Number(event.currentTarget.value || each.range_m) - each.range_m)} />
                  <span>m</span>
                </label>
                <label>
                  <span>price</span>
                  <input type="number" min={0} step="any" value={each.cost} aria-label={`Price of ${each.name}`} onChange={(event) => setKindField(n, { cost: Math.max(0, Number(event.currentTarget.value) || 0) })} />
                </label>
              </>
            )}
          </div>
        ))}
        {!fixed && kinds.length < 6 && (
          <button type="button" class="quiet" onClick={() => setPlacing({ ...placing, kinds: [...kinds, { name: `kind ${kinds.length + 1}`, range_m: kinds[kinds.length - 1].range_m * 2, cost: kinds[kinds.length - 1].cost * 2 }] })}>+ another kind</button>
        )}
      </div>
    </section>
  );
}
