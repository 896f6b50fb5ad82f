// The rollouts in the scene: the best trial, or one that is pinned instead, and the one that the pointer is at.

import { element } from "./common.js";
import { isSame } from "./charts.js";

/** @typedef {import("./charts.js").Pointed} Pointed */

const POINT_PERIOD = 60; // ms between two points that the pointer asks for

export class Rollouts {
  shown = -1; // the trial that is shown as the best
  pinned = false; // whether it is another one than the best
  /** @type {Pointed} */
  #pointed = null; // what the pointer is at: {trial} or {drive}
  #waits = false; // whether the pointer has moved since it was asked for

  /** @param {any} page of the study */
  constructor(page) {
    this.page = page;
    this.text = element("output", { id: "vtb-pointed" });
    const conditions = page.hello.conditions.map((/** @type {any} */ _, /** @type {number} */ k) =>
      element("option", { value: k }, `condition ${k}`),
    );
    const title = "condition of the rollouts that are shown";
    const change = () => {
      page.draw();
      this.pin(this.shown >= 0 ? this.shown : page.trials.best);
    };
    this.select = element("select", { id: "vtb-condition", title, ariaLabel: title, onchange: change }, ...conditions);
  }

  get condition() {
    return Number(this.select.value);
  }

  /** @param {Pointed} pick what the pointer is at, whose ghost is shown; null for nothing */
  point(pick) {
    if (isSame(pick, this.#pointed)) return;
    this.#pointed = pick;
    this.text.textContent = pick ? this.#described(pick) : "";
    this.page.charts.point(pick);
    if (this.#waits) return;
    this.#waits = true;
    setTimeout(() => {
      this.#waits = false;
      this.#showPointed();
    }, POINT_PERIOD);
  }

  async #showPointed() {
    const { page } = this;
    const pick = this.#pointed;
    if (!page.hello.simulates) return;
    if (!pick) {
      page.playback.legend("pointed", false);
      await page.ask("hide", { role: "pointed" }).catch(() => {});
      return;
    }
    const { trial, drive: number } = pick;
    const isTrial = trial !== undefined;
    const source = isTrial ? { trial, condition: this.condition } : { driven: number };
    try {
      const shown = await page.ask("show", { role: "pointed", ...source });
      if (!isSame(this.#pointed, pick)) return;
      page.playback.legend("pointed", true);
      page.playback.extend(shown.duration);
      document.body.dataset.pointed = isTrial ? String(trial) : `drive ${number}`;
      const drive = isTrial ? null : page.drives.numbered(number);
      const isTold = isTrial ? page.trials.kinds[trial] === "failed" : shown.message === drive?.message;
      if (shown.message && !isTold) this.text.append(` ${shown.message}`);
    } catch (error) {
      if (isSame(this.#pointed, pick)) this.text.append(` ${/** @type {Error} */ (error).message}`);
    }
  }

  /**
   * @param {NonNullable<Pointed>} pick
   * @returns {string}
   */
  #described(pick) {
    const { page } = this;
    const values = (/** @type {(number | null)[]} */ column) =>
      column.map((value, q) => page.valued(q, value)).join(", ");
    const places = (/** @type {(number | null)[]} */ point) =>
      point.map((value, p) => `${page.parameterLabel(p)} ${page.valueText(p, value)}`).join(", ");
    if (pick.trial === undefined) {
      const drive = page.drives.numbered(pick.drive);
      if (!drive) return "";
      const remark = drive.kind === "broken" ? " (breaks a constraint)" : "";
      const message = drive.message && `, ${drive.message}`;
      return `driven by ${drive.name}: ${values(drive.values)}${remark}${message}; from ${places(drive.point)}`;
    }
    const { trial: k } = pick,
      { trials } = page;
    /** @type {Record<string, string>} */
    const remarks = {
      failed: ` failed: ${trials.reasons[k] ?? ""}`,
      broken: " (breaks a constraint)",
      dropped: " (dropped by racing)",
      feasible: "",
    };
    const origin = trials.byHand.has(k) ? ", by hand" : "";
    const column = trials.values.map((/** @type {number[]} */ numbers) => numbers[k]);
    return `trial ${k}${origin}: ${values(column)}${remarks[trials.kinds[k]]}; ${places(trials.point(k))}`;
  }

  /** @param {number} k the trial that is shown instead of the best, until the best itself is clicked */
  pin(k) {
    if (k < 0) return;
    this.pinned = k !== this.page.trials.best;
    this.showBest(k);
    this.page.attempts.setDraft(this.page.trials.point(k));
  }

  /** @param {number} k the trial that is shown as the best */
  async showBest(k) {
    const { page } = this;
    this.shown = k;
    if (page.attempts.followsBest) page.attempts.setDraft(page.trials.point(k), { followsBest: true });
    page.table.show();
    if (!page.hello.simulates) return;
    try {
      const shown = await page.ask("show", { role: "best", trial: k, condition: this.condition });
      page.playback.legend("best", true, this.pinned ? `trial ${k}` : `${page.bestText}, trial ${k}`);
      page.playback.extend(shown.duration);
      page.bestThrift.spent(shown.seconds ?? 0);
      document.body.dataset.best = String(k);
      if (shown.message) page.say(shown.message, "bad");
    } catch (error) {
      if (this.shown === k) page.say(`trial ${k} is not shown: ${/** @type {Error} */ (error).message}`, "bad");
    }
  }
}
