/** Which way of the asset is up, as it was set last: the server may be at work on it. */

import { computed } from "@preact/signals";

import { state } from "./store";
import { during, withUnderWay } from "./under-way";
import { axisName, type Axis } from "./up-axis";
import { run } from "../editor/editor";

const NAME = "up";

/** null: along none of the axes. */
export const shownUp = computed<Axis | null>(() => withUnderWay(NAME, axisName(state.value?.asset.up)));

/** For every window and for good; the Gaussians stay as they are. */
export const setUp = (up: Axis, what: string) => during(NAME, () => up, run("asset.up", { up }, what));
