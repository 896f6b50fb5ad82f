// The controls of a session, beside Meshcat's viewer, whose page loads this module.

import { Camera } from "./camera.js";
import { Connection, Telling, button, choice, element, isHeld, load } from "./common.js";
import { Drive } from "./drive.js";
import { GhostLegend, otherCourse } from "./ghost_legend.js";
import { Keep } from "./keep.js";
import { KeySheet } from "./keys.js";
import { Layers } from "./layers.js";
import { Loop } from "./loop.js";
import { Recorded } from "./recorded.js";
import { Search } from "./search.js";
import { Switches } from "./switches.js";
import { Theme, remember, remembered } from "./theme.js";
import { VirtualReality } from "./vr.js";
import { Watched } from "./watched.js";

const SPEEDS = [0.125, 0.25, 0.5, 1, 2, 4, 8];
const DIFFERENCES = 12; // differences from another course that are listed
const PREVIEW_PERIOD = 100; // ms between two drafts
const UNDOABLE = 50; // changes that can be undone
// The course beside the present one, as the table of differences calls it.
const COURSES = {
  recorded: "recorded course (purple)",
  branch: "other branch (orange)",
  without: "course without the change (blue)",
};
const NARROW = matchMedia("(max-width: 700px)"); // where the panel lies over the scene
// Where keys belong to what is typed, or where space presses the control itself.
const TYPED = "input[type=text], input[type=search], select";
const PRESSED = "button, summary, a, input[type=checkbox]";

/**
 * What a page looks like, as the browser remembers it by the name of the scenario.
 *
 * @typedef {{ watched: { address: string, plotted: boolean }[], folded: boolean, compare: boolean, layers: string[],
 *   follow: string }} Layout
 */

class Page extends Telling {
  /** @type {Map<string, Watched>} */
  watched = new Map();
  /** @type {Record<string, import("./watched.js").Variable>} */
  variables = {};
  /** @type {{ watched: Watched, values: Record<string, any> } | null} */
  draft = null;
  /** @type {Record<string, any>[]} */
  changes = []; // the values before each change, the last one at the end
  /** @type {Set<string>} */
  commands = new Set();
  search = new Search((address) => this.watch(address));
  undoButton = button("vtb-undo", "undo", "undo the last change (Ctrl z)", () => this.undo());
  playButton = button("vtb-play", "play", "play or pause (space)", () => this.toggle());
  foldButton = button("vtb-fold", "☰", "show or hide the panel (m)", () => this.fold());
  frames = 0;
  playing = false;
  loop = "";
  layoutKey = ""; // empty until the layout is the one that was remembered
  reflected = 0; // the last command that has been carried out before the frame that is shown
  // The last commands that let time run, change its speed, and go back.
  asked = { play: 0, speed: 0, seek: 0 };
  scrubbing = false;
  speedChosen = 1;
  speed = choice(
    { id: "vtb-speed", title: "speed (+ and -)", "aria-label": "speed" },
    (value) => this.#setSpeed(Number(value)),
    ...SPEEDS.map((speed) => element("option", { value: speed }, speed < 1 ? `1/${1 / speed} ×` : `${speed} ×`)),
  );
  /** @type {ReturnType<typeof setTimeout> | null} */
  timer = null;
  /** @type {ReturnType<typeof setTimeout> | null} */
  seekTimer = null;

  constructor() {
    super();
    this.camera = new Camera();
    this.ghosts = new GhostLegend();
    this.keySheet = new KeySheet();
    this.layers = new Layers(this);
    this.switches = new Switches(this);
    // Each has a section of the panel in `root`, and is told of the session's messages.
    this.parts = [
      new Recorded(this),
      new Drive(this),
      this.layers,
      new Keep(this),
      new Loop(this),
      new VirtualReality(this),
      this.switches,
    ];
    this.#build();
    this.session = new Connection({
      hello: (/** @type {any} */ message) => this.#hello(message),
      frame: (/** @type {any} */ frame) => this.#frame(frame),
      closed: () => this.lose(this.panel, this.bar, this.camera.toolbar),
    });
    document.addEventListener("keydown", (event) => this.#key(event));
  }

  #build() {
    this.title = element("h1");
    this.sections = element("div", { id: "vtb-variables" });
    this.differences = element("table", { id: "vtb-differences" });
    this.compare = element("input", { type: "checkbox", id: "vtb-compare", onchange: () => this.keepLayout() });
    this.undoButton.disabled = true;
    this.camera.follow.addEventListener("change", () => this.keepLayout());
    this.panel = element(
      "aside",
      { id: "vtb-panel", tabIndex: -1, "aria-label": "panel" },
      this.title,
      element("h2", {}, "Variables"),
      this.search.root,
      this.sections,
      element(
        "p",
        { id: "vtb-changes" },
        element("label", {}, this.compare, " show the course without the change, too"),
        this.undoButton,
      ),
      this.differences,
      ...this.parts.map((part) => part.root),
      this.camera.root,
    );
    this.bar = this.#makeBar();
    document.body.append(this.panel, this.bar);
    document.documentElement.lang = "en";
    this.speed.value = "1";
    this.fold(NARROW.matches);
  }

  #makeBar() {
    this.clock = element("output", { id: "vtb-time", title: "simulated time" });
    this.rate = element("output", { id: "vtb-rate", title: "simulated seconds per second" });
    this.history = element("input", {
      id: "vtb-history",
      type: "range",
      step: "any",
      title: "go back",
      "aria-label": "time, to go back",
      oninput: () => this.#scrub(),
      onchange: () => (this.scrubbing = false),
      onpointerup: () => (this.scrubbing = false),
    });
    this.foldButton.setAttribute("aria-controls", "vtb-panel");
    return element(
      "footer",
      { id: "vtb-bar" },
      this.foldButton,
      this.playButton,
      button("vtb-step", "step", "one step (.)", () => this.ask("step")),
      button("vtb-reset", "reset", "begin again (r)", () => this.ask("reset")),
      this.speed,
      this.clock,
      this.rate,
      this.switches.mode,
      this.history,
      new Theme().button,
      this.keySheet.button,
    );
  }

  /** @param {any} message */
  #hello(message) {
    const { scenario, variables, bodies } = message;
    this.variables = variables;
    this.search.hello(variables);
    this.commands = new Set(message.commands);
    this.loop = message.loop;
    for (const part of this.parts) part.hello(message);
    this.camera.hello(bodies, message.followed);
    this.ghosts.hello(message.tints);
    this.title.textContent = scenario.split(":").at(-1);
    this.title.title = scenario;
    document.title = this.title.textContent;
    this.#restoreLayout(scenario, message.opening);
    if (Object.keys(message.vr).length) this.fold(false); // A headset, narrow or not, enters by the panel.
    document.body.dataset.session = "open";
  }

  // Whether the session carries out a command.
  /** @param {string} command */
  can(command) {
    return this.commands.has(command);
  }

  /**
   * Returns the result of a command; undefined if it was refused, which is told.
   *
   * @param {string} command
   * @param {Record<string, any>} [fields]
   * @param {string} [kind] of the message
   * @returns {Promise<any>}
   */
  ask(command, fields, kind) {
    return this.orTell(this.session.ask(command, fields), kind);
  }

  // -- the layout

  /**
   * @param {string} scenario
   * @param {string[]} opening addresses to begin with, where the browser remembers nothing
   */
  #restoreLayout(scenario, opening) {
    const key = `vtb-layout ${scenario}`;
    /** @type {Layout | null} */
    const layout = remembered(key);
    const watched = layout?.watched ?? opening.map((address) => ({ address, plotted: false }));
    for (const { address, plotted } of watched) {
      if (this.variables[address]) this.#add(address, plotted);
    }
    if (layout) {
      this.compare.checked = layout.compare;
      this.layers.restore(layout.layers);
      if (layout.follow !== this.camera.follow.value && ["", ...this.camera.bodies].includes(layout.follow))
        this.camera.follow.value = layout.follow;
      if (!NARROW.matches) this.fold(layout.folded);
    }
    this.#askToWatch();
    this.layoutKey = key;
  }

  // Lets the browser remember what the page looks like.
  keepLayout() {
    if (!this.layoutKey) return;
    const watched = [...this.watched.values()].map(({ address, plot }) => ({ address, plotted: plot !== null }));
    /** @type {Layout} */
    const layout = {
      watched,
      folded: this.isFolded,
      compare: this.compare.checked,
      layers: this.layers.shown(),
      follow: this.camera.follow.value,
    };
    remember(this.layoutKey, layout);
  }

  get isFolded() {
    return document.body.classList.contains("vtb-folded");
  }

  fold(folded = !this.isFolded) {
    document.body.classList.toggle("vtb-folded", folded);
    this.foldButton.setAttribute("aria-expanded", String(!folded));
    dispatchEvent(new Event("resize"));
    this.keepLayout();
  }

  // -- variables

  /** @param {string} address */
  watch(address) {
    if (!this.watched.has(address)) {
      this.#add(address, false);
      this.sections.prepend(this.watched.get(address)?.root);
      this.#askToWatch();
      this.keepLayout();
    }
    this.watched.get(address)?.root.scrollIntoView({ block: "nearest" });
  }

  /**
   * @param {string} address
   * @param {boolean} plotted
   */
  #add(address, plotted) {
    const watched = new Watched(this, address, this.variables[address]);
    this.watched.set(address, watched);
    this.sections.append(watched.root);
    if (plotted) watched.togglePlot();
  }

  /** @param {Watched} watched */
  unwatch(watched) {
    watched.remove();
    this.watched.delete(watched.address);
    this.#askToWatch();
    this.keepLayout();
  }

  #askToWatch() {
    this.ask("watch", { addresses: [...this.watched.keys()] });
  }

  /**
   * @param {Watched} watched
   * @param {Record<string, any>} values
   */
  preview(watched, values) {
    this.draft = { watched, values };
    if (!this.can("preview")) return;
    this.timer ??= setTimeout(() => {
      this.timer = null;
      if (this.draft) this.ask("preview", { values: this.draft.values });
    }, PREVIEW_PERIOD);
  }

  /**
   * @param {Record<string, any>} values
   * @param {Record<string, any> | null} before the values that they replace, as far as they are known
   */
  async commit(values, before) {
    this.draft = null;
    // Before the answer: who sees the new value can undo it.
    if (before) this.#setChanges([...this.changes.slice(1 - UNDOABLE), before]);
    const answer = await this.ask("write", { values, compare: this.compare.checked });
    if (answer === undefined && before) this.#setChanges(this.changes.filter((change) => change !== before));
  }

  /** @param {Record<string, any>[]} changes */
  #setChanges(changes) {
    this.changes = changes;
    this.undoButton.disabled = !changes.length;
  }

  // Sets what was changed last to the values that it had before.
  async undo() {
    const before = this.changes.at(-1);
    if (!before) return;
    this.#setChanges(this.changes.slice(0, -1));
    const answer = await this.ask("write", { values: before, compare: false });
    if (answer !== undefined) this.say(`${Object.keys(before).join(", ")} as before the change`, "draft");
  }

  // What was dragged is where it was before: there is nothing to commit.
  dropDraft() {
    this.draft = null;
    if (this.can("cancel_preview")) this.ask("cancel_preview");
  }

  cancel() {
    this.draft?.watched.close("cancelled");
    this.draft = null;
    if (document.body.dataset.seeking) this.ask("pause");
    for (const command of ["cancel_preview", "cancel_comparison"]) if (this.can(command)) this.ask(command);
  }

  // -- time

  // What is pressed again before a frame has come means the opposite.
  toggle() {
    this.playing = !this.playing;
    this.#showPlaying();
    this.ask(this.playing ? "play" : "pause");
    this.asked.play = this.session.asked;
  }

  #showPlaying() {
    this.playButton.textContent = this.playing ? "pause" : "play";
  }

  /** @param {number} by */
  #changeSpeed(by) {
    const speed = SPEEDS[SPEEDS.indexOf(this.speedChosen) + by];
    if (speed) this.#setSpeed(speed);
  }

  /** @param {number} speed */
  #setSpeed(speed) {
    this.speedChosen = speed;
    this.speed.value = String(speed);
    this.ask("speed", { speed });
    this.asked.speed = this.session.asked;
  }

  #scrub() {
    this.scrubbing = true;
    this.seekTimer ??= setTimeout(() => {
      this.seekTimer = null;
      this.ask("seek", { time: Number(this.history.value) });
      this.asked.seek = this.session.asked;
    }, PREVIEW_PERIOD);
  }

  /** @param {KeyboardEvent} event */
  #key(event) {
    const target = /** @type {Element} */ (event.target);
    if (this.keySheet.isOpen || document.body.dataset.session === "lost") return;
    if (target.matches(TYPED)) {
      if (event.key === "Escape") /** @type {HTMLElement} */ (target).blur();
      return;
    }
    if (event.key === " " && target.matches(PRESSED)) return;
    const action = this.#action(event);
    if (!action) return;
    event.preventDefault();
    action();
  }

  /**
   * @param {KeyboardEvent} event
   * @returns {(() => void) | undefined} what its key does
   */
  #action({ key, ctrlKey, metaKey, altKey, shiftKey }) {
    if ((ctrlKey || metaKey) && !altKey && !shiftKey && key === "z") return () => this.undo();
    if (ctrlKey || metaKey || altKey) return undefined;
    /** @type {Record<string, () => void>} */
    const played = {
      " ": () => this.toggle(),
      ".": () => this.ask("step"),
      "+": () => this.#changeSpeed(1),
      "-": () => this.#changeSpeed(-1),
    };
    /** @type {Record<string, () => void>} */
    const always = {
      r: () => this.ask("reset"),
      m: () => this.fold(),
      "/": () => this.#find(),
      "?": () => this.keySheet.root.showModal(),
      Escape: () => this.cancel(),
      ...this.camera.keys,
    };
    return always[key] ?? (this.can("play") ? played[key] : undefined);
  }

  #find() {
    this.fold(false);
    this.search.input.focus();
  }

  // -- what comes from the session

  /**
   * Whether the frame that is shown was made after a command: an older one must not take back what a person sees.
   *
   * @param {number} command its number
   */
  reflects(command) {
    return this.reflected >= command;
  }

  /** @param {any} frame */
  #frame(frame) {
    this.reflected = frame.reflects;
    if (this.reflects(this.asked.play)) this.playing = frame.playing;
    this.#showPlaying();
    this.clock.textContent = `${frame.time.toFixed(3)} s`;
    this.rate.textContent = frame.playing ? `${frame.rate.toFixed(2)} ×` : this.loop ? "no values" : "paused";
    if (this.reflects(this.asked.speed) && !isHeld(this.speed)) {
      this.speedChosen = frame.speed;
      this.speed.value = frame.speed;
    }
    [this.history.min, this.history.max] = frame.history;
    if (!this.scrubbing && !this.seekTimer && this.reflects(this.asked.seek))
      this.history.value = frame.log?.seeking ?? frame.time;
    for (const [address, value] of Object.entries(frame.values)) this.watched.get(address)?.show(frame.time, value);
    this.#showState(frame);
    for (const part of this.parts) part.frame(frame);
    this.ghosts.frame(frame, this.layers.isOn("perceived"));
    this.frames += 1;
    document.body.dataset.frame = frame.number;
    document.body.dataset.frames = String(this.frames);
  }

  /** @param {any} frame */
  #showState({ steers, failure, warnings, preview, comparison, picture }) {
    if (steers) this.takeBack("steering");
    else if (!this.told("steering")) {
      const take = element("button", { id: "vtb-take", onclick: () => this.ask("take over") }, "steer here");
      this.say("another page steers: this one watches ", "", "steering");
      this.told("steering")?.append(take);
    }
    this.#tell("failure", failure && !this.loop ? `the simulation has failed: ${failure}` : failure);
    this.#tell("picture", picture);
    this.#tell("warnings", warnings.join("; "));
    const when = preview && `${preview.time.toFixed(2)} s`;
    if (preview?.refused) this.#tell("preview", `preview: ${preview.refused}, at ${when}`);
    else this.#tell("preview", preview ? `preview until ${when}` : "", "draft");
    this.#showComparison(comparison);
  }

  /**
   * Tells something of a kind as long as it is true; an empty text takes it back.
   *
   * @param {string} kind
   * @param {string} text
   * @param {string} className
   */
  #tell(kind, text, className = "bad") {
    if (text) this.say(text, className, kind);
    else this.takeBack(kind);
  }

  /** @param {any} comparison */
  #showComparison(comparison) {
    const { rows } = this.differences;
    if (!comparison) {
      if (rows.length) this.differences.replaceChildren();
      return;
    }
    const differences = comparison.differences.slice(0, DIFFERENCES);
    const course = COURSES[otherCourse(comparison)];
    const title = differences.length ? `differs first from the ${course}:` : `no difference yet from the ${course}`;
    if (rows.length === differences.length + 1 && rows[0].textContent === title) return;
    const head = element("tr", {}, element("td", { colSpan: 2 }, title));
    const cells = differences.map((/** @type {[string, number]} */ [address, time]) =>
      element("tr", {}, element("td", {}, address), element("td", {}, `${time.toFixed(3)} s`)),
    );
    this.differences.replaceChildren(head, ...cells);
  }
}

await Promise.all([
  load("link", { rel: "stylesheet", href: "page/view.css" }),
  load("link", { rel: "stylesheet", href: "page/vendor/uPlot.min.css" }),
  load("script", { src: "page/vendor/uPlot.iife.min.js" }),
]);
globalThis.vtb = new Page();
vtb.camera.followBody();
