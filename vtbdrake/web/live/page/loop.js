// A loop that runs in another process: the ages of its messages, what keeps it from the machine, and its faults.

import { element } from "./common.js";

const OLD = 1; // s, from which on a fault is told with its age

export class Loop {
  /** @param {any} page */
  constructor(page) {
    this.page = page;
    this.address = element("p");
    this.reasons = element("ul");
    this.ages = element("table");
    this.faults = element("ul");
    this.root = element(
      "div",
      { id: "vtb-loop", hidden: true },
      element("h2", {}, "Loop"),
      this.address,
      this.reasons,
      this.ages,
      this.faults,
    );
  }

  /** @param {{ loop: string }} message */
  hello({ loop }) {
    this.root.hidden = !loop;
    document.body.classList.toggle("vtb-live", Boolean(loop));
    if (!loop) return;
    this.address.textContent = `at ${loop}`;
    this.age = element("output", { id: "vtb-age", title: "the oldest of the last messages" });
    document.getElementById("vtb-mode")?.before(this.age);
    const reset = document.getElementById("vtb-reset");
    if (reset) reset.title = "let the DPS command again after a fault that is over (r)";
  }

  /** @param {{ loop: any, playing: boolean, failure: string }} frame */
  frame({ loop, playing, failure }) {
    if (!loop) return;
    document.body.dataset.loop = failure ? "silent" : playing ? "running" : "awaited";
    const item = (/** @type {string} */ text) => element("li", {}, text);
    this.reasons.replaceChildren(
      ...(loop.reasons ?? []).map((/** @type {string} */ reason) => item(`not commanded: ${reason}`)),
    );
    /** @type {[string, number | null][]} */
    const ages = Object.entries(loop.ages ?? {});
    const ago = (/** @type {number | null} */ age) =>
      age === null ? "never" : `${(1e3 * age).toFixed(age < 0.1 ? 1 : 0)} ms ago`;
    this.ages.replaceChildren(
      ...ages.map(([signal, age]) => element("tr", {}, element("td", {}, signal), element("td", {}, ago(age)))),
    );
    const oldest = ages.some(([, age]) => age === null) ? null : Math.max(...ages.map(([, age]) => Number(age)));
    this.age.textContent = ages.length ? ago(oldest) : "";
    this.faults.replaceChildren(
      ...(loop.faults ?? []).map((/** @type {[string, number]} */ [reason, age]) =>
        item(age < OLD ? reason : `${reason} (${age.toFixed(0)} s ago)`),
      ),
    );
  }
}
