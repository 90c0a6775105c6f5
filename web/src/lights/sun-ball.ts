/**
 * The ball on which a sun is dragged: seen from the side of the view, from its middle (the sun stands behind the eye) over
 * its rim (light from the side) to twice as far (the sun is behind the asset). Pure.
 */

/** Where a sun stands, degrees: azimuth counter-clockwise seen from above, 0 at the front; elevation above the horizon. */
export interface SunPlace {
  azimuth: number;
  elevation: number;
}

/** A point of the ball in its radii from the middle, y up. At more than 1 it is on the far side. */
export interface BallPoint {
  x: number;
  y: number;
}

const RADIANS = Math.PI / 180;
/** As far as a drag reaches: the point behind the middle. */
const MAX_REACH = 2;

/** -180 .. 180. */
const turned = (degrees: number): number => ((((degrees + 180) % 360) + 360) % 360) - 180;

/** The sun at a point of the ball. viewAzimuth: of the camera, degrees. */
export function sunAt({ x, y }: BallPoint, viewAzimuth = 0): SunPlace {
  const reach = Math.min(MAX_REACH, Math.hypot(x, y));
  const angle = reach * 90 * RADIANS; // from the line of sight; even steps of it are even steps of the hand
  const [right, up] = reach === 0 ? [0, 0] : [x / Math.hypot(x, y), y / Math.hypot(x, y)];
  const [sine, cosine] = [Math.sin(angle), Math.cos(angle)];
  const elevation = Math.asin(Math.max(-1, Math.min(1, up * sine))) / RADIANS;
  const azimuth = Math.atan2(right * sine, cosine) / RADIANS;
  return { azimuth: turned(azimuth + viewAzimuth), elevation };
}

/** Where a sun is on the ball: the inverse of `sunAt`. */
export function ballPoint({ azimuth, elevation }: SunPlace, viewAzimuth = 0): BallPoint {
  const [side, height] = [(azimuth - viewAzimuth) * RADIANS, elevation * RADIANS];
  const [right, up, ahead] = [Math.sin(side) * Math.cos(height), Math.sin(height), Math.cos(side) * Math.cos(height)];
  const reach = Math.acos(Math.max(-1, Math.min(1, ahead))) / (90 * RADIANS);
  const across = Math.hypot(right, up);
  return across < 1e-12
    ? { x: ahead < 0 ? MAX_REACH : 0, y: 0 }
    : { x: (right / across) * reach, y: (up / across) * reach };
}

/** The same place as it is drawn on the ball itself: beyond the rim it comes back on the far side. */
export function shownPoint(point: BallPoint): BallPoint & { behind: boolean } {
  const reach = Math.hypot(point.x, point.y);
  const radius = Math.sin(Math.min(MAX_REACH, reach) * 90 * RADIANS);
  const scale = reach === 0 ? 0 : radius / reach;
  return { x: point.x * scale, y: point.y * scale, behind: reach > 1 };
}

/** By a key: degrees to the right and up. Elevations end at straight up and straight down. */
export const nudged = ({ azimuth, elevation }: SunPlace, right: number, up: number): SunPlace => ({
  azimuth: turned(azimuth + right),
  elevation: Math.max(-90, Math.min(90, elevation + up)),
});

/**
 * Azimuth of a view, degrees, as suns have it. world_to_camera: its rows; up: unit vector along an axis of the asset
 * (axes_of in lights/light_set.py).
 */
export function azimuthOf(worldToCamera: readonly (readonly number[])[], up: readonly number[]): number {
  const back = worldToCamera[2].slice(0, 3).map((value) => -value); // from the middle to the eye
  const cross = (a: readonly number[], b: readonly number[]) =>
    [0, 1, 2].map((k) => a[(k + 1) % 3] * b[(k + 2) % 3] - a[(k + 2) % 3] * b[(k + 1) % 3]);
  const dot = (a: readonly number[], b: readonly number[]) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
  const side = cross(up, Math.abs(up[2]) < 0.9 ? [0, 0, 1] : [1, 0, 0]);
  return Math.atan2(dot(side, back), dot(cross(side, up), back)) / RADIANS;
}

/** "from the right, above": for those who do not see the ball. */
export function spokenPlace({ azimuth, elevation }: SunPlace): string {
  const sides = ["the front", "the right", "behind", "the left"];
  const side = sides[Math.round((turned(azimuth) + 360) / 90) % 4];
  return `from ${side}, ${Math.round(Math.abs(elevation))}° ${elevation < 0 ? "below" : "above"} the horizon`;
}
