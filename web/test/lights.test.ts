import { describe, expect, it } from "vitest";

import { KELVIN_RANGE, kelvinColor } from "../src/lights/kelvin";
import {
  asHex,
  asKelvin,
  changedLamp,
  changedSun,
  hexOf,
  isFull,
  isLit,
  lightFields,
  lightsOf,
  MAX_LIGHTS,
  NO_LIGHT,
  without,
  withLamp,
  withSun,
  type LampLight,
  type LightSettings,
} from "../src/lights/lights";
import { rounded } from "../src/ui/parts";
import { draggedAcross, draggedAlong, eyeOf, outlines } from "../src/lights/lamp-drag";
import { zoned } from "../src/lights/light-files";
import { azimuthOf, ballPoint, nudged, shownPoint, spokenPlace, sunAt } from "../src/lights/sun-ball";
import { lookAt, project, sub, toCamera, type Vec3 } from "../src/view/camera";

const ASSET = { center: [1, 2, 3], radius: 2, up: [0, -1, 0] };

describe("the ball", () => {
  it("has the sun behind the eye in its middle, above at its top, behind the asset beyond its rim", () => {
    expect(sunAt({ x: 0, y: 0 })).toEqual({ azimuth: 0, elevation: 0 });
    expect(sunAt({ x: 0, y: 1 }).elevation).toBeCloseTo(90);
    expect(sunAt({ x: 1, y: 0 })).toEqual({ azimuth: expect.closeTo(90), elevation: expect.closeTo(0) });
    expect(sunAt({ x: -1.5, y: 0 }).azimuth).toBeCloseTo(-135);
    expect(Math.abs(sunAt({ x: 3, y: 0 }).azimuth)).toBeCloseTo(180); // no drag goes farther
    expect(sunAt({ x: 0, y: 0.5 }, 120)).toEqual({ azimuth: expect.closeTo(120), elevation: expect.closeTo(45) });
  });

  it("shows every place where it was dragged, from every view", () => {
    for (let k = 0; k < 200; k++) {
      const [azimuth, elevation, view] = [(k * 77) % 360, ((k * 37) % 178) - 89, (k * 53) % 360];
      const back = sunAt(ballPoint({ azimuth, elevation }, view), view);
      expect(back.elevation).toBeCloseTo(elevation, 5);
      expect(Math.cos(((back.azimuth - azimuth) * Math.PI) / 180)).toBeCloseTo(1, 6);
    }
  });

  it("draws it inside of the ball, on the far side where it is behind", () => {
    expect(shownPoint({ x: 0.5, y: 0 })).toEqual({ x: expect.closeTo(Math.SQRT1_2), y: 0, behind: false });
    expect(shownPoint({ x: 0, y: 1.5 })).toEqual({ x: 0, y: expect.closeTo(Math.SQRT1_2), behind: true });
    for (const reach of [0, 0.3, 1, 1.7, 2]) {
      const { x, y } = shownPoint({ x: reach * 0.6, y: reach * 0.8 });
      expect(Math.hypot(x, y)).toBeLessThanOrEqual(1 + 1e-9);
    }
  });

  it("is moved by keys, and says in words where the light comes from", () => {
    expect(nudged({ azimuth: 178, elevation: 88 }, 5, 5)).toEqual({ azimuth: -177, elevation: 90 });
    expect(spokenPlace({ azimuth: 100, elevation: 20 })).toBe("from the right, 20° above the horizon");
    expect(spokenPlace({ azimuth: -170, elevation: -4.6 })).toBe("from behind, 5° below the horizon");
  });
});

describe("temperatures", () => {
  it.each([
    [1667, [2.9641, 0.521, 0]],
    [2700, [1.9294, 0.8051, 0.193]],
    [4000, [1.4147, 0.9238, 0.5334]],
    [6500, [1.0426, 0.9838, 1.0351]],
    [25000, [0.7273, 0.9875, 1.9274]],
  ])("are the colours that the package has: %d K", (kelvin, color) => {
    kelvinColor(kelvin).forEach((value, k) => expect(value).toBeCloseTo(color[k], 3));
    const [red, green, blue] = kelvinColor(kelvin); // Rec. 709 luminance
    if (blue > 0) expect(0.2126 * red + 0.7152 * green + 0.0722 * blue).toBeCloseTo(1, 3);
  });

  it("and colours become each other", () => {
    expect(hexOf({ kelvin: 2700 })).toMatch(/^#ff[0-9a-f]{4}$/);
    expect(asHex({ kelvin: 6500 })).toEqual({ hex: hexOf({ kelvin: 6500 }) });
    for (const kelvin of [2700, 4500, 8000]) {
      const back = asKelvin(asHex({ kelvin }));
      expect("kelvin" in back && Math.abs(back.kelvin / kelvin - 1)).toBeLessThan(0.05);
    }
    expect(asKelvin({ hex: "#ff0000" })).toEqual({ kelvin: expect.any(Number) });
    expect(kelvinColor(1)).toEqual(kelvinColor(KELVIN_RANGE[0]).map(() => expect.any(Number)));
  });
});

describe("lights", () => {
  it("are put above the asset, changed and taken away one by one", () => {
    let lights = withLamp(withSun(withSun(NO_LIGHT), -30, 10), "spot", ASSET);
    expect(isLit(NO_LIGHT)).toBe(false);
    expect(isLit(lights)).toBe(true);
    const [first, second] = lights.suns;
    const [lamp] = lights.lamps;
    expect(new Set([first.id, second.id, lamp.id]).size).toBe(3);
    expect(lamp).toMatchObject({ position: [1, -1, 3], target: [1, 2, 3], sizes: [40], intensity: 4 });
    lights = changedLamp(changedSun(lights, second.id, { elevation: 80 }), lamp.id, { intensity: 9 });
    expect([lights.suns[0].elevation, lights.suns[1].elevation, lights.lamps[0].intensity]).toEqual([40, 80, 9]);
    lights = without(lights, first.id);
    expect(lights.suns.map(({ azimuth }) => azimuth)).toEqual([second.azimuth]);
    expect([...lights.suns, ...lights.lamps].map(({ id }) => id)).toEqual([1, 2]);
    const more = withLamp(lights, "point", ASSET);
    expect(more.lamps.map(({ kind, id }) => [kind, id])).toEqual([
      ["point", 2],
      ["spot", 3],
    ]);
  });

  it("are at most as many as the operation takes", () => {
    let lights = NO_LIGHT;
    for (let k = 0; k < MAX_LIGHTS + 3; k++) lights = k % 2 ? withSun(lights) : withLamp(lights, "point", ASSET);
    expect(lights.suns.length + lights.lamps.length).toBe(MAX_LIGHTS);
    expect(isFull(lights)).toBe(true);
  });

  it("are told to the operation as words of the command line", () => {
    let lights = { ...NO_LIGHT, sky: "sunset", rotate: 40, exposure: 0.5, mix: 0, add: true };
    lights = withSun(lights, 120, 35);
    lights = changedSun(lights, lights.suns[0].id, { color: { hex: "#ffe0b0" }, intensity: 2 });
    lights = withLamp(withLamp(lights, "point", ASSET), "rect", ASSET);
    const [point] = lights.lamps;
    lights = changedLamp(lights, point.id, { color: { kelvin: 2700 }, intensity: 1 });
    const fields = lightFields(lights);
    expect(fields).toMatchObject({ hdri: "sunset", rotate: 40, exposure: 0.5, mix: 0.01, add: true, shadows: true });
    expect(fields.sun).toEqual(["120,35,#ffe0b0,2,0.53"]);
    expect(fields.point).toEqual(["1,-1,3,2700K,1"]);
    expect(fields.rect[0].split(",").length).toBe(3 + 3 + 2 + 2);
    expect([fields.spot, fields.disk, fields.sphere]).toEqual([[], [], []]);
  });
});

describe("a lamp in the view", () => {
  const pose = lookAt([1, 2, -4], [0, 0, 0], [0, -1, 0], 40);
  const view = toCamera(pose, 800, 600, [0, 0, 0]);

  it("follows the hand across the view at its distance, and keeps its place on the screen along it", () => {
    const point: Vec3 = [0.4, -0.7, 0.9];
    const [x, y, z] = project(view, point);
    const [across, down, depth] = project(view, draggedAcross(view, point, 37, -21));
    expect([across - x, down - y, depth - z]).toEqual([expect.closeTo(37), expect.closeTo(-21), expect.closeTo(0)]);
    const [right, below, far] = project(view, draggedAlong(view, point, -120));
    expect([right, below, far / z]).toEqual([expect.closeTo(x), expect.closeTo(y), expect.closeTo(2)]);
    expect(Math.hypot(...sub(eyeOf(view), [1, 2, -4]))).toBeCloseTo(0);
  });

  it("shows its size, and what a spot reaches", () => {
    const base = { ...withLamp(NO_LIGHT, "rect", ASSET).lamps[0], position: [0, 0, 0], target: [0, 0, 5] } as LampLight;
    const [rect] = outlines({ ...base, sizes: [2, 1] });
    const edges = rect.slice(1).map((corner, k) => Math.hypot(...sub(corner, rect[k])));
    expect(edges.map((edge) => Math.round(edge * 1e6) / 1e6).sort()).toEqual([1, 1, 2, 2]);
    expect(rect.every(([, , z]) => z === 0)).toBe(true);
    const [rim, ...sides] = outlines({ ...base, kind: "spot", sizes: [90] });
    for (const point of rim) expect([point[2], Math.hypot(point[0], point[1])]).toEqual([5, expect.closeTo(5)]);
    expect(sides.every(([start]) => start.every((value) => value === 0))).toBe(true);
    for (const line of outlines({ ...base, kind: "sphere", sizes: [0.5] }))
      for (const point of line) expect(Math.hypot(...point)).toBeCloseTo(0.5);
    expect(outlines({ ...base, kind: "point", sizes: [] })).toEqual([]);
  });
});

describe("a time with its zone", () => {
  it("is written as ISO 8601 has it, also west of Greenwich and at half hours", () => {
    expect(zoned({ time: "2026-06-21T15:00", zone: 2 })).toBe("2026-06-21T15:00+02:00");
    expect(zoned({ time: "2026-06-21T15:00", zone: -3.5 })).toBe("2026-06-21T15:00-03:30");
    expect(zoned({ time: "2026-06-21T15:00", zone: 0 })).toBe("2026-06-21T15:00+00:00");
  });
});

describe("a layer of light", () => {
  const full = () => {
    let lights: LightSettings = { ...NO_LIGHT, rotate: 40, exposure: -1.5, mix: 0.25, add: true, shadows: false };
    lights = withSun(withSun(lights, -70, 12), 30, -5);
    for (const kind of ["point", "spot", "rect", "disk", "sphere"] as const) lights = withLamp(lights, kind, ASSET);
    const source = { name: "studio.hdr", held: "a".repeat(64) };
    lights = { ...lights, sky: "mine.hdr", held: "b".repeat(64), source, fill: 0.3 };
    lights = changedSun(lights, 1, { color: { kelvin: 4200 }, size: 25 });
    return { ...lights, lamps: lights.lamps.map((one) => ({ ...one, color: { hex: "#ffe0b0" }, intensity: 3.5 })) };
  };

  it("is read as it was written, whatever is in it", () => {
    const lights = full();
    const { mix, ...options } = lightFields(lights);
    const back = lightsOf(options, mix);
    expect(lightFields(back)).toEqual(lightFields(lights));
    expect({ ...back, suns: [], lamps: [] }).toEqual({ ...lights, suns: [], lamps: [] });
    const plain = ({ id: _, ...rest }: { id: number }) => rest;
    expect(back.suns.map(plain)).toEqual(lights.suns.map(plain));
    const aimless = (one: (typeof lights.lamps)[number]) =>
      ["point", "sphere"].includes(one.kind) ? { ...one, target: [0, 0, 0] } : one;
    expect(back.lamps.map(plain)).toEqual(lights.lamps.map(aimless).map(plain));
    const ids = [...back.suns, ...back.lamps].map(({ id }) => id);
    expect(new Set(ids).size).toBe(ids.length);
  });

  it("has lamps where maps have them", () => {
    const far = { ...ASSET, center: [691234.25, 5334567.5, 512.125] };
    const [point] = lightFields(withLamp(NO_LIGHT, "point", far)).point;
    expect(point.split(",").slice(0, 3).map(Number)).toEqual([691234.25, 5334564.5, 512.125]);
  });

  it("has defaults for what it does not say", () => {
    expect(lightsOf({}, 1)).toEqual(NO_LIGHT);
    const [sun] = lightsOf({ sun: ["10,20"] }, 1).suns;
    expect(sun).toMatchObject({ azimuth: 10, elevation: 20, color: { hex: "#ffffff" }, intensity: 1 });
    const [warm] = lightsOf({ sun: ["10,20,2"], kelvin: 2700 }, 1).suns;
    expect(warm).toMatchObject({ color: { kelvin: 2700 }, intensity: 2, size: 0.53 });
    expect(lightsOf({ sun: ["10,20"], sun_size: 12 }, 1).suns[0].size).toBe(12);
  });

  it("has azimuths as cameras have them, whichever way is up", () => {
    // the rows of views towards the middle, from +z of the axes of lights and a quarter turn counter-clockwise from there
    const row = (forward: number[]) => [[], [], [...forward, 0]];
    expect(azimuthOf(row([0, 0, -1]), [0, -1, 0])).toBeCloseTo(0);
    expect(azimuthOf(row([1, 0, 0]), [0, -1, 0])).toBeCloseTo(90); // from -x, which lies on the right where -y is up
    expect(azimuthOf(row([-1, 0, 0]), [0, 1, 0])).toBeCloseTo(90);
    expect(azimuthOf(row([-1, 0, 0]), [0, 0, 1])).toBeCloseTo(0);
    expect(azimuthOf(row([0, -1, 0]), [0, 0, 1])).toBeCloseTo(90);
  });
});

it("what rounds to zero has no sign", () => {
  expect([rounded(-0.001, 2), rounded(-0, 0), rounded(-0.006, 2), rounded(3.14159, 3)]).toEqual([
    "0.00",
    "0",
    "-0.01",
    "3.142",
  ]);
});
