// The log of a session: it says whether the log is replayed, and lets the simulation go on from there.

import { element } from "./common.js";

export class Recorded {
  constructor(page) {
    this.page = page;
    this.text = element("p", { id: "vtb-log-text" });
    this.goOn = element("button", { id: "vtb-go-on", title: "from the recorded state of the DPS, with the recorded course as a ghost", onclick: () => page.ask("go_on") }, "go on in simulation");
    this.back = element("button", { id: "vtb-back-to-log", title: "to where the simulation has left it", onclick: () => page.ask("seek", { time: this.left - 1e-6 }) }, "back to the log");
    this.root = element("div", { id: "vtb-log", hidden: true }, element("h2", {}, "Log"), this.text, element("p", { className: "vtb-buttons" }, this.goOn, this.back));
  }

  hello({ log }) {
    this.root.hidden = !log;
    this.name = log.split(/[\\/]/).at(-1);
    this.root.title = log;
  }

  frame({ log }) {
    if (!log) return;
    this.left = log.left;
    document.body.dataset.log = log.recorded ? "recorded" : "simulated";
    this.text.textContent = log.recorded
      ? `${this.name}: what was recorded. A change goes on in simulation from here.`
      : `simulated since ${log.left.toFixed(3)} s; the purple ghost is what was recorded.`;
    this.goOn.hidden = !log.recorded;
    this.back.hidden = log.recorded;
    if (log.notice) this.page.say(log.notice, "", "log");
    else this.page.takeBack("log");
  }
}
