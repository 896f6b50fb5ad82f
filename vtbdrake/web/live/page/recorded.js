// The log of a session: it says whether the log is replayed, and lets the simulation go on from there.

import { element } from "./common.js";

export class Recorded {
  /** @param {any} page */
  constructor(page) {
    this.page = page;
    this.text = element("p", { id: "vtb-log-text" });
    this.goOn = element(
      "button",
      {
        id: "vtb-go-on",
        title: "from the recorded state of the DPS, with the recorded course as a ghost",
        onclick: () => page.ask("go_on"),
      },
      "go on in simulation",
    );
    this.back = element(
      "button",
      {
        id: "vtb-back-to-log",
        title: "to where the simulation has left it",
        onclick: () => page.ask("seek", { time: this.left - 1e-6 }),
      },
      "back to the log",
    );
    this.progress = element("progress", { id: "vtb-log-progress" });
    this.stop = element(
      "button",
      { id: "vtb-stop-seek", title: "stay where the replay is now (Escape)", onclick: () => page.ask("pause") },
      "stop here",
    );
    this.way = element("p", { id: "vtb-log-way", hidden: true }, this.progress, " ", this.stop);
    const buttons = element("p", { className: "vtb-buttons" }, this.goOn, this.back);
    this.root = element("div", { id: "vtb-log", hidden: true }, element("h2", {}, "Log"), this.text, this.way, buttons);
  }

  /** @param {{ log: string }} message */
  hello({ log }) {
    this.root.hidden = !log;
    this.name = log.split(/[\\/]/).at(-1);
    this.root.title = log;
  }

  /** @param {{ log: any }} frame */
  frame({ log }) {
    if (!log) return;
    this.left = log.left;
    document.body.dataset.log = log.recorded ? "recorded" : "simulated";
    const seeking = log.seeking !== null;
    this.way.hidden = !seeking;
    this.progress.value = log.progress ?? 0;
    document.body.dataset.seeking = seeking ? log.seeking.toFixed(3) : "";
    this.text.textContent = seeking
      ? `on the way to ${log.seeking.toFixed(3)} s: the log is replayed up to there.`
      : log.recorded
        ? `${this.name}: what was recorded. A change goes on in simulation from here.${ahead(log)}`
        : `simulated since ${log.left.toFixed(3)} s; the purple ghost is what was recorded.`;
    this.goOn.hidden = !log.recorded || seeking;
    this.back.hidden = log.recorded;
    if (log.notice) this.page.say(log.notice, "", "log");
    else this.page.takeBack("log");
  }
}

/**
 * @param {{ prepared: number }} log
 * @returns {string} what is said while states along the log are still being kept
 */
function ahead({ prepared }) {
  return prepared < 1 ? ` Replayed ahead: ${Math.floor(100 * prepared)} %; ways beyond that take longer.` : "";
}
