/** What each sensor sees, asked for while it is dragged. */
import { useEffect, useRef, useState } from "preact/hooks";
import type { Api } from "./api";
import type { Look, Placing, Stand, Workspace } from "./types";

const keyOf = (stand: Stand, range: number, sight: boolean) =>
  `${stand.pole ?? `${stand.x},${stand.y}`}|${range}|${sight}`;

/** What each sensor sees: answers are kept, and while one is awaited the last one of the sensor is shown. */
export function useLooks(api: Api, space: Workspace, placing: Placing, stands: Stand[], fail: (error: unknown) => void) {
  const kept = useRef({ space: space.key, looks: new Map<string, Look>() });
  const last = useRef(new Map<number, Look>());
  const asking = useRef(new Set<string>());
  const [, again] = useState(0);
  if (kept.current.space !== space.key) {
    kept.current = { space: space.key, looks: new Map() };
    last.current = new Map();
  }
  const wanted = stands.map((stand) => ({ stand, key: keyOf(stand, placing.kinds[stand.kind].range_m, placing.sight) }));
  useEffect(() => {
    for (const { stand, key } of wanted) {
      const { looks, space: of } = kept.current;
      // One question at a time for each sensor: while it is dragged, places that it has left are not asked for.
      const mark = `${stand.id}`;
      if (looks.has(key) || asking.current.has(mark)) continue;
      asking.current.add(mark);
      performance.mark("look-asked");
      api
        .look(space.key, stand, placing.kinds[stand.kind].range_m, placing.sight)
        .then((look) => {
          if (kept.current.space === of) kept.current.looks.set(key, look);
          requestAnimationFrame(() => performance.measure("look", "look-asked"));
        })
        .catch(fail)
        .finally(() => {
          asking.current.delete(mark);
          again((count) => count + 1);
        });
    }
  });
  const found = new Map<number, Look>();
  let settled = true;
  for (const { stand, key } of wanted) {
    const look = kept.current.looks.get(key);
    if (look) last.current.set(stand.id, look);
    else settled = false;
    const shown = look ?? last.current.get(stand.id);
    if (shown) found.set(stand.id, shown);
  }
  return { looks: found, settled };
}
