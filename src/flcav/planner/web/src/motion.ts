/** Where road users of a recorded drive are at an instant: between recorded poses by a cubic along their headings. */
import type { Drive, Pose } from "./types";

export type Placed = { name: string; walks: boolean; size: [number, number]; pose: Pose };

const turnTo = (from: number, to: number, part: number) => from + (((((to - from) % (2 * Math.PI)) + 3 * Math.PI) % (2 * Math.PI)) - Math.PI) * part;

/** The pose between two, `part` of the `seconds` after the first. */
export function between(from: Pose, to: Pose, part: number, seconds: number): Pose {
  const [u, v] = [part * part, part * part * part];
  const weights = [2 * v - 3 * u + 1, v - 2 * u + part, -2 * v + 3 * u, v - u];
  const along = (pose: Pose, axis: 0 | 1) => pose[3] * seconds * (axis ? Math.sin(pose[2]) : Math.cos(pose[2]));
  const at = (axis: 0 | 1) => weights[0] * from[axis] + weights[1] * along(from, axis) + weights[2] * to[axis] + weights[3] * along(to, axis);
  return [at(0), at(1), turnTo(from[2], to[2], part), from[3] + (to[3] - from[3]) * part];
}

export const lengthOf = (drive: Drive) => drive.times[drive.times.length - 1];

/** Everybody who is there at an instant [s] of a drive. */
export function placeUsers(drive: Drive, time: number): Placed[] {
  const { times, users } = drive;
  const next = times.findIndex((each) => each > time);
  const [i, j] = next < 0 ? [times.length - 1, times.length - 1] : [Math.max(next - 1, 0), next];
  const seconds = times[j] - times[i];
  return users.flatMap(({ name, walks, size, path }) => {
    const [from, to] = [path[i], path[j]];
    const pose = from && to && seconds > 0 ? between(from, to, (time - times[i]) / seconds, seconds) : from;
    return pose ? [{ name, walks, size, pose }] : [];
  });
}
