// The page of a study, beside Meshcat's viewer, whose page loads this module.

import { Attempts } from "./attempts.js";
import { Connection, Telling, button, counted, element, load, number, replaceContent } from "./common.js";
import { Interventions } from "./interventions.js";
import { Playback } from "./playback.js";
import { Rollouts } from "./rollouts.js";
import { Scale } from "./scale.js";
import { StudyCharts } from "./study_charts.js";
import { Theme } from "./theme.js";
import { Thrift } from "./thrift.js";
import { TrialTable } from "./trial_table.js";
import { Drives, Trials } from "./trials.js";

/** @type {any} */
const UNMADE = null;
const TABS = ["trials", "try", "search", "changes", "failures"];

/** @param {number} s */
const duration = (s) =>
  s < 90 ? `${Math.round(s)} s` : s < 5400 ? `${Math.round(s / 60)} min` : `${(s / 3600).toFixed(1)} h`;

/**
 * @param {string} name
 * @param {string} unit
 * @returns {string} the name with its unit, such as "mass [kg]"
 */
const named = (name, unit) => (unit && unit !== "1" ? `${name} [${unit}]` : name);

class Page extends Telling {
  /** @type {any} */
  status = null; // where the study stands
  /** @type {any} */
  hello = null; // what the study is
  /** @type {any[]} */
  parameters = [];
  /** @type {any[]} */
  qualities = [];
  trials = new Trials([]);
  drives = new Drives();
  bestThrift = new Thrift();
  // Its parts, which are made when it knows what the study is.
  /** @type {Interventions} */
  interventions = UNMADE;
  /** @type {StudyCharts} */
  charts = UNMADE;
  /** @type {Rollouts} */
  rollouts = UNMADE;
  /** @type {Attempts} */
  attempts = UNMADE;
  /** @type {Playback} */
  playback = UNMADE;
  /** @type {TrialTable} */
  table = UNMADE;
  /** @type {Record<string, HTMLElement>} */
  sections = {};
  /** @type {HTMLElement} */
  tabs = UNMADE;
  /** @type {HTMLButtonElement} */
  fold = UNMADE;

  constructor() {
    super();
    this.connection = new Connection({
      hello: (message) => this.#hello(message),
      trials: (message) => this.#take(message),
      status: (message) => this.#showStatus(message),
      picture: ({ notice }) => this.say(notice, "bad", "picture"),
      closed: () => this.lose(...(this.playback ? [this.head, this.main, this.playback.bar] : [])),
    });
    document.addEventListener("keydown", (event) => this.#key(event));
  }

  /**
   * @param {string} command
   * @param {object} [fields]
   */
  ask(command, fields) {
    return this.connection.ask(command, fields);
  }

  /**
   * Asks for what a person wants; undefined if it was refused, which is told.
   *
   * @param {string} command
   * @param {object} [fields]
   */
  do(command, fields) {
    return this.orTell(this.ask(command, fields));
  }

  get isRunning() {
    return this.status?.state === "running";
  }

  // -- elements

  /** @param {any} hello what the study is */
  #hello(hello) {
    this.hello = hello;
    this.parameters = hello.parameters;
    this.qualities = hello.qualities;
    this.trials = new Trials(this.qualities.map(({ minimize }) => (minimize ? -1 : 1)));
    document.title = `${hello.name}: study`;
    this.#build();
    document.body.dataset.session = "open";
    if (!hello.simulates) this.note(`no rollouts are shown: ${hello.obstacle}`, "obstacle");
    if (hello.changes.length) this.note(`the code has changed since: ${hello.changes.join("; ")}`, "changes");
  }

  #build() {
    const { hello } = this;
    this.interventions = new Interventions(this);
    this.charts = new StudyCharts(this);
    this.rollouts = new Rollouts(this);
    this.attempts = new Attempts(this);
    const conditions = hello.conditions.length > 1 ? [this.rollouts.select] : [];
    /** @type {(command: string, fields: object) => Promise<any>} */
    const ask = (command, fields) => this.ask(command, fields);
    this.playback = new Playback(ask, hello.simulates, ...conditions);
    this.facts = element("div", { id: "vtb-facts", tabIndex: 0, role: "group", ariaLabel: "where the study stands" });
    this.table = new TrialTable(this);
    this.failures = element("table", { id: "vtb-failures" });
    this.sections = {
      trials: this.table.section,
      try: this.attempts.section,
      search: this.interventions.search,
      changes: this.interventions.changes,
      failures: this.failures,
    };
    const tab = (/** @type {string} */ name) =>
      element("button", { id: `vtb-tab-${name}`, onclick: () => this.openTab(name) }, name);
    this.tabs = element("nav", { className: "vtb-tabs", ariaLabel: "trials and search" }, ...TABS.map(tab));
    const title = element("h1", { title: hello.path }, hello.name);
    this.fold = button("vtb-fold", "panel", "show or hide the panel", () => this.#fold());
    this.fold.setAttribute("aria-expanded", "true");
    const { controls } = this.interventions;
    this.head = element("header", { id: "vtb-head" }, this.fold, title, this.facts, controls, new Theme().button);
    this.main = element(
      "main",
      { id: "vtb-study" },
      this.charts.switch,
      this.charts.selectors,
      ...Object.values(this.charts.views).map((view) => view.element),
      this.charts.remark,
      this.charts.colors.element,
      this.charts.legend.list,
      this.rollouts.text,
      this.charts.history.canvas,
      this.tabs,
      ...Object.values(this.sections),
    );
    document.body.append(this.head, this.main, this.playback.bar);
    this.charts.choose("landscape");
    this.openTab("trials");
    dispatchEvent(new Event("resize"));
  }

  /** @param {string} name */
  openTab(name) {
    for (const [key, section] of Object.entries(this.sections)) section.hidden = key !== name;
    for (const tab of this.tabs.children) {
      tab.classList.toggle("chosen", tab.id === `vtb-tab-${name}`);
      tab.setAttribute("aria-pressed", String(tab.id === `vtb-tab-${name}`));
    }
    this.draw();
  }

  #fold() {
    const folded = document.body.classList.toggle("vtb-folded");
    this.fold.setAttribute("aria-expanded", String(!folded));
    dispatchEvent(new Event("resize"));
  }

  /**
   * Shows a message until it is clicked.
   *
   * @param {string} text
   * @param {string} kind
   */
  note(text, kind) {
    this.say(text, "", kind);
    const shown = /** @type {HTMLElement} */ (this.told(kind));
    Object.assign(shown, { title: "a click hides it", onclick: () => shown.remove() });
  }

  // -- what comes from the study

  /** @param {any} message with new trials */
  #take(message) {
    this.trials.take(message);
    this.charts.renew();
    this.draw();
    document.body.dataset.trials = String(this.trials.count);
    this.#renewBest();
  }

  #renewBest() {
    const { best } = this.trials;
    if (best < 0 || best === this.rollouts.shown || this.rollouts.pinned) return;
    if (this.isRunning && this.bestThrift.rests) return;
    this.rollouts.showBest(best);
  }

  /** @param {any} status */
  #showStatus(status) {
    const ended = this.isRunning && status.state !== "running";
    this.status = status;
    if (this.drives.take(status.driven)) {
      document.body.dataset.driven = status.driven.numbers.length;
      this.draw();
    }
    if (JSON.stringify(this.parameters) !== JSON.stringify(status.parameters)) {
      this.parameters = status.parameters;
      this.draw();
    }
    this.#showFacts(status);
    if (status.message) this.say(status.message, "bad", "file");
    else this.takeBack("file");
    this.#showDeath(status.state);
    this.#showFailures(status);
    this.interventions.show(status);
    this.#renewBest();
    if (ended) this.draw(); // The model need not rest any more.
    document.body.dataset.state = status.state;
    document.body.dataset.rollouts = status.rollouts;
  }

  /** @param {any} status */
  #showFacts({ state, reason, rollouts, budget, left, rate, solver, paused, interventions }) {
    const { best, front, methods, values } = this.trials;
    const method = methods.at(-1);
    const waiting = interventions.filter(
      (/** @type {any} */ { kind, batch }) => kind === "try" && batch === null,
    ).length;
    const running = paused ? "paused" : "running";
    /** @type {Record<string, string>} */
    const states = { new: "not begun", running, ended: `ended (${reason})`, died: "its process has died" };
    const facts = {
      state: states[state],
      // Points that are given by hand with their rollouts may exceed it.
      rollouts: !budget
        ? `${rollouts}`
        : rollouts > budget
          ? `${rollouts} (${budget} asked for)`
          : `${rollouts} of ${budget}`,
      ...(left !== null && left !== undefined ? { left: duration(left) } : {}),
      ...(rate ? { rate: `${number(Math.round(rate * 10) / 10)} per s` } : {}),
      solver: method && method !== solver ? `${solver} (${method})` : solver,
      ...(waiting ? { waiting: counted(waiting, "point") } : {}),
      ...(best >= 0 && this.qualities.length === 1 ? { best: this.withUnit(0, values[0][best]) } : {}),
      ...(this.qualities.length > 1 && front.length ? { front: counted(front.length, "trial") } : {}),
    };
    const fact = (/** @type {[string, any]} */ [name, text]) => {
      const properties = { "data-fact": name, className: name === "state" ? state : "" };
      return element("span", properties, element("small", {}, name), text);
    };
    this.facts.replaceChildren(...Object.entries(facts).map(fact));
  }

  /** @param {string} state */
  #showDeath(state) {
    if (state !== "died") return this.takeBack("died");
    if (this.told("died")) return;
    this.say("the process that ran the study has died; what it had finished is kept. ", "bad", "died");
    const told = /** @type {HTMLElement} */ (this.told("died"));
    if (!this.hello.command) {
      told.append("Run its program again to go on.");
      return;
    }
    told.append(
      element("button", { id: "vtb-resume", onclick: () => this.interventions.run() }, "go on in a process of its own"),
      element("small", {}, " or: ", element("code", {}, this.hello.command)),
    );
  }

  /** @param {any} status */
  #showFailures({ failures, ends }) {
    const rows = failures.map((/** @type {[string, number, number | null]} */ [message, count, first]) => {
      const cells = [element("td", {}, `${count} ×`), element("td", {}, message || "no reason was recorded")];
      return element("tr", { onclick: () => first !== null && this.rollouts.pin(first) }, ...cells);
    });
    const counts = Object.entries(ends).map(([end, count]) => `${end} ${count}`);
    const nothing = element("tr", {}, element("td", {}, "no rollout has failed"));
    const caption = counts.length ? `rollouts ended by: ${counts.join(", ")}` : "no rollout has ended yet";
    replaceContent(this.failures, element("caption", {}, caption), ...(rows.length ? rows : [nothing]));
    const tab = /** @type {HTMLElement} */ (this.tabs.querySelector("#vtb-tab-failures"));
    tab.textContent = rows.length ? `failures (${ends.failed})` : "failures";
  }

  // -- what its parts share

  /** @returns {string} what the best trial is called */
  get bestText() {
    return this.qualities.length > 1 ? `front's best ${this.qualityLabel(0)}` : "best";
  }

  /**
   * @param {number} k
   * @returns {string} the name of a parameter, as short as it can be
   */
  parameterLabel(k) {
    return this.parameters[k].label;
  }

  /**
   * @param {number} q
   * @returns {string} the name of a quality
   */
  qualityLabel(q) {
    return this.qualities[q].name;
  }

  /**
   * @param {number} q
   * @returns {string} the name of a quality, with an arrow to where it is better
   */
  qualityArrow(q) {
    return `${this.qualityLabel(q)} ${this.qualities[q].minimize ? "↓" : "↑"}`;
  }

  /**
   * @param {number} q
   * @returns {string} name, unit and direction of a quality
   */
  qualityText(q) {
    const { name, unit, minimize } = this.qualities[q];
    return `${named(name, unit)}, ${minimize ? "minimize ↓" : "maximize ↑"}`;
  }

  /**
   * @param {number} q
   * @param {number | null} value
   * @returns {string} the value of a quality with its unit
   */
  withUnit(q, value) {
    const { unit } = this.qualities[q];
    return unit && unit !== "1" && value !== null ? `${number(value)} ${unit}` : number(value);
  }

  /**
   * @param {number} q
   * @param {number | null} value
   * @returns {string} such as "energy = 3 J"
   */
  valued(q, value) {
    return `${this.qualityLabel(q)} = ${this.withUnit(q, value)}`;
  }

  /**
   * @param {number} parameter
   * @param {number} value of a choice the number of its option
   * @returns {string}
   */
  valueText(parameter, value) {
    const { options } = this.parameters[parameter];
    return options ? options[value] : number(value);
  }

  /**
   * @param {number} k
   * @param {string} [name]
   * @returns {Scale} the scale of a parameter
   */
  scale(k, name = this.parameters[k].address) {
    const { unit, lower, upper, log, integer, options } = this.parameters[k];
    return new Scale({ label: named(name, unit), lower, upper, log, integer, options });
  }

  draw() {
    if (this.playback) this.charts.draw(); // Before, there are not all parts.
  }

  /** @param {KeyboardEvent} event */
  #key(event) {
    const target = /** @type {HTMLElement} */ (event.target);
    if (event.key !== " " || target.matches("input, select, button, summary")) return;
    if (!this.playback || document.body.dataset.session === "lost") return;
    event.preventDefault();
    this.playback.play(!this.playback.playing);
  }
}

await Promise.all([
  load("link", { rel: "stylesheet", href: "page/view.css" }),
  load("link", { rel: "stylesheet", href: "page/study.css" }),
]);
globalThis.vtb = new Page();
