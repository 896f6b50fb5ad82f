// The page of a study, beside Meshcat's viewer, whose page loads this module.

import { Parallel, Scale, Scatter, color } from "./charts.js";
import { Connection, Telling, element, load, number } from "./common.js";
import { Steering } from "./steering.js";

const LISTED = 8; // best trials in the table
const POINT_PERIOD = 60; // ms between two points that the pointer asks for
const TIME_PERIOD = 50; // ms between two instants of the animation
const MODEL_GROWTH = 1.2; // by how much the trials grow before the model is asked for again
const SHARE = 0.003; // of a core, what a page takes by itself while the study runs, for the model and for new bests
const DRIVEN = "#e69f00"; // marks of rollouts that were driven by hand
const TABS = ["best", "try", "search", "changes", "failures"];

const duration = (s) => (s < 90 ? `${Math.round(s)} s` : s < 5400 ? `${Math.round(s / 60)} min` : `${(s / 3600).toFixed(1)} h`);
const short = (address) => address.split(".").slice(-2).join(".");

class Trials {
  constructor() {
    Object.assign(this, { points: [], values: [], kinds: [], methods: [], batches: [], byHand: new Set(), reasons: {} });
  }

  get count() {
    return this.kinds.length;
  }

  // Takes new trials behind the first ones; the others were recorded again.
  take({ first, points, values, kinds, methods, batches, by_hand, reasons }) {
    const extend = (mine, news) => {
      mine.length = Math.min(mine.length, first);
      for (const value of news) mine.push(value);
    };
    points.forEach((column, k) => extend((this.points[k] ??= []), column));
    (values.length ? values : this.values.map(() => [])).forEach((column, k) => extend((this.values[k] ??= []), column));
    extend(this.kinds, kinds);
    extend(this.methods, methods);
    extend(this.batches, batches);
    for (const k of [...this.byHand]) if (k >= first) this.byHand.delete(k);
    for (const k of by_hand) this.byHand.add(first + k);
    for (const k of Object.keys(this.reasons)) if (k >= first) delete this.reasons[k];
    for (const [k, reason] of Object.entries(reasons)) this.reasons[first + Number(k)] = reason;
  }

  point(k) {
    return this.points.map((column) => column[k]);
  }
}

// What the page does by itself, without being asked to, rests after each time so that it takes a small share of a core.
class Thrift {
  constructor() {
    this.next = 0;
  }

  get rests() {
    return performance.now() < this.next;
  }

  spent(seconds) {
    this.next = performance.now() + (1000 * seconds) / SHARE;
  }
}

class Page extends Telling {
  constructor() {
    super();
    this.trials = new Trials();
    this.time = 0;
    this.duration = 0;
    this.pointed = this.best = -1;
    this.driven = []; // [{number, name, point, values, kind, message, after}]
    Object.assign(this, { front: [], ranking: [], bestLine: [], shadeOf: {}, modelThrift: new Thrift(), bestThrift: new Thrift() });
    this.connection = new Connection({
      hello: (message) => this.#hello(message),
      trials: (message) => this.#take(message),
      status: (message) => this.#showStatus(message),
      closed: () => {
        document.body.dataset.page = "ended";
        this.say("the page has lost its server: begin it again (vtbdrake study open)", "bad", "closed");
      },
    });
    document.addEventListener("keydown", (event) => this.#key(event));
  }

  ask(command, fields) {
    return this.connection.ask(command, fields);
  }

  // Asks for what a person wants; an error is told.
  do(command, fields) {
    return this.ask(command, fields).catch((error) => this.say(error.message, "bad"));
  }

  // -- elements

  #hello(hello) {
    Object.assign(this, { hello, parameters: hello.parameters, qualities: hello.qualities });
    this.sign = this.qualities.map(({ minimize }) => (minimize ? -1 : 1));
    document.title = `${hello.name}: study`;
    this.#build();
    document.body.dataset.page = "open";
    if (!hello.simulates) this.note(`no rollouts are shown: ${hello.obstacle}`, "obstacle");
    if (hello.changes.length) this.note(`the code has changed since: ${hello.changes.join("; ")}`, "changes");
  }

  #build() {
    const choice = (id, title, texts, value) =>
      element("select", { id, title, onchange: () => this.#draw() }, ...texts.map((text, k) => element("option", { value: k, selected: k === value }, text)));
    const brief = this.parameters.map(({ address }) => short(address));
    const labels = new Set(brief).size === brief.length ? brief : this.parameters.map(({ address }) => address);
    const events = {
      onpoint: (k) => this.point(k),
      onleave: () => this.point(-1),
      onclick: (k, ...values) => this.#click(k, values),
    };
    this.steering = new Steering(this);
    this.landscape = new Scatter("vtb-landscape", {
      ...events,
      height: 0.3,
      drags: () => (this.steering.forbids && this.parameters.length > 1 ? "box" : ""),
      ondrag: (from, to) => this.steering.forbid([Number(this.xAxis.value), Number(this.yAxis.value)], from, to),
    });
    this.parallel = new Parallel("vtb-parallel", { ...events, height: 0.3 });
    this.pareto = new Scatter("vtb-pareto", { ...events, height: 0.3, drags: () => "target", ondrag: (_, to) => this.steering.aim(to) });
    this.history = new Scatter("vtb-history-chart", { ...events, height: 0.14, onclick: (k) => k >= 0 && this.#pin(k) });
    this.xAxis = choice("vtb-x", "horizontal axis", labels, 0);
    this.yAxis = choice("vtb-y", "vertical axis", labels.length > 1 ? labels : ["value"], Math.min(1, labels.length - 1));
    this.quality = choice("vtb-quality", "quality", this.qualities.map(({ name }) => name), 0);
    this.condition = choice("vtb-condition", "condition of the rollouts that are shown", this.hello.conditions.map((c, k) => `condition ${k}`), 0);
    this.condition.addEventListener("change", () => this.#pin(this.shownBest ?? this.best));
    this.model = element("input", { type: "checkbox", id: "vtb-model", checked: true, onchange: () => this.#draw() });
    this.views = { landscape: this.landscape, parallel: this.parallel, pareto: this.pareto };
    const shown = ["landscape", ...(labels.length > 2 ? ["parallel"] : []), ...(this.qualities.length > 1 ? ["pareto"] : [])];
    this.switch = element("nav", { className: "vtb-tabs" }, ...shown.map((name) => element("button", { id: `vtb-view-${name}`, onclick: () => this.#choose(name) }, name)));
    this.facts = element("div", { id: "vtb-facts" });
    this.bestTable = element("table", { id: "vtb-best" });
    this.failures = element("table", { id: "vtb-failures" });
    this.sections = { best: this.bestTable, try: this.#buildTry(), search: this.steering.search, changes: this.steering.changes, failures: this.failures };
    this.tabs = element("nav", { className: "vtb-tabs" }, ...TABS.map((name) => element("button", { id: `vtb-tab-${name}`, onclick: () => this.openTab(name) }, name)));
    this.pointedText = element("output", { id: "vtb-pointed" });
    this.header = element("header", { id: "vtb-head" }, element("h1", { title: this.hello.path }, this.hello.name), this.facts, this.steering.controls);
    this.selectors = element("div", { className: "vtb-row" }, this.xAxis, this.yAxis, this.qualities.length > 1 ? this.quality : "", element("label", {}, this.model, " model"));
    document.body.append(
      this.header,
      element(
        "aside",
        { id: "vtb-study" },
        this.switch,
        this.selectors,
        this.landscape.canvas,
        this.parallel.canvas,
        this.pareto.canvas,
        this.pointedText,
        this.history.canvas,
        this.tabs,
        ...Object.values(this.sections),
      ),
      this.#buildBar(),
    );
    this.view = "landscape";
    this.#choose("landscape");
    this.openTab("best");
    dispatchEvent(new Event("resize"));
  }

  #buildBar() {
    this.playButton = element("button", { id: "vtb-play", title: "play or pause (space)", onclick: () => this.play(!this.playing) }, "play");
    this.slider = element("input", { id: "vtb-time", type: "range", min: 0, max: 1, step: "any", value: 0, title: "time of the rollouts", oninput: () => this.setTime(Number(this.slider.value)) });
    this.clock = element("output", { id: "vtb-clock" }, "0.00 s");
    const legend = [["best", "#5d6870"], ["pointed", "#cc3399"], ["tried", "#009e73"]].map(([name, tint]) =>
      element("span", { className: "vtb-key", id: `vtb-key-${name}`, hidden: true }, element("i", { style: `background:${tint}` }), name),
    );
    return element("footer", { id: "vtb-bar" }, this.playButton, this.clock, this.slider, ...legend, this.hello.conditions.length > 1 ? this.condition : "");
  }

  #buildTry() {
    this.tryInputs = this.parameters.map((parameter, k) => {
      const { address, unit, options } = parameter;
      const show = () => (text.value = options ? options[this.draft[k]] : number(this.draft[k]));
      const scale = this.scale(k);
      const slider = element("input", {
        type: "range", min: 0, max: 1, step: options ? 1 / Math.max(1, options.length - 1) : "any", "aria-label": address,
        oninput: () => {
          const value = options ? Math.round(Number(slider.value) * (options.length - 1)) : scale.value(Number(slider.value));
          this.setDraft(this.draft.map((old, i) => (i === k ? (parameter.integer ? Math.round(value) : value) : old)));
        },
        onchange: () => this.attempt(),
      });
      const text = element("input", { type: "text", readOnly: !!options, "aria-label": address, onchange: () => {
        if (text.value.trim() !== "" && Number.isFinite(Number(text.value))) this.setDraft(this.draft.map((old, i) => (i === k ? Number(text.value) : old)));
        else show();
      } });
      const update = () => {
        slider.value = options ? this.draft[k] / Math.max(1, options.length - 1) : scale.unit(this.draft[k]);
        show();
      };
      return { update, row: element("div", { className: "vtb-entry" }, element("label", { title: address }, `${short(address)} ${unit === "1" || !unit ? "" : `[${unit}]`}`), slider, text) };
    });
    this.draft = this.parameters.map((_, k) => this.scale(k).value(0.5));
    this.tryResult = element("output", { id: "vtb-tried" });
    const simulates = this.hello.simulates;
    const section = element(
      "section",
      { id: "vtb-try" },
      ...this.tryInputs.map(({ row }) => row),
      element(
        "div",
        { className: "vtb-row" },
        element("button", { id: "vtb-attempt", disabled: !simulates, title: simulates ? "" : this.hello.obstacle, onclick: () => this.attempt() }, "try it here"),
        element("button", { id: "vtb-add", title: "it is evaluated with the next batch, and the solver learns from it", onclick: () => this.#give() }, "give it to the study"),
        element("label", {}, (this.tryByClick = element("input", { type: "checkbox", id: "vtb-try-click" })), " a click into the landscape tries"),
      ),
      this.tryResult,
    );
    this.tryInputs.forEach(({ update }) => update());
    return section;
  }

  #choose(name) {
    this.view = name;
    for (const [key, chart] of Object.entries(this.views)) chart.canvas.hidden = key !== name;
    for (const button of this.switch.children) button.classList.toggle("chosen", button.id === `vtb-view-${name}`);
    this.selectors.hidden = name === "pareto";
    const axes = this.parameters.length;
    this.xAxis.hidden = name !== "landscape" || axes < 1;
    for (const part of [this.yAxis, this.model.parentElement]) part.hidden = name !== "landscape" || axes < 2;
    this.#draw();
  }

  openTab(name) {
    for (const [key, section] of Object.entries(this.sections)) section.hidden = key !== name;
    for (const button of this.tabs.children) button.classList.toggle("chosen", button.id === `vtb-tab-${name}`);
  }

  // Shows a message until it is clicked.
  note(text, kind) {
    const shown = this.say(text, "", kind);
    Object.assign(shown, { title: "a click hides it", onclick: () => shown.remove() });
  }

  // -- what comes from the study

  #take(message) {
    this.trials.take(message);
    this.#findBest();
    this.#draw();
    document.body.dataset.trials = this.trials.count;
    this.#renewBest();
  }

  get #running() {
    return this.status?.state === "running";
  }

  #renewBest() {
    if (this.best < 0 || this.best === this.shownBest || this.pinned || (this.#running && this.bestThrift.rests)) return;
    this.#showBest(this.best);
  }

  // What may be the best: the feasible trials that are not forbidden now.
  #candidates() {
    const feasible = [];
    this.trials.kinds.forEach((kind, k) => kind === "feasible" && feasible.push(k));
    return this.status?.forbidden.length ? feasible.filter((k) => !this.steering.excludes(this.trials.point(k))) : feasible;
  }

  #findBest() {
    const { kinds, values } = this.trials, candidates = this.#candidates();
    this.best = -1;
    this.bestLine = [];
    this.shadeOf = {};
    if (this.qualities.length > 1) {
      this.ranking = this.front = paretoFront(candidates, values, this.sign);
      this.best = this.front.length ? this.front[0] : -1;
      return;
    }
    this.ranking = candidates.toSorted((a, b) => this.sign[0] * (values[0][b] - values[0][a])).slice(0, LISTED);
    candidates.forEach((k) => {
      const value = values[0][k];
      if (this.best >= 0 && this.sign[0] * value <= this.sign[0] * values[0][this.best]) return;
      if (this.best >= 0) this.bestLine.push([k, values[0][this.best]]);
      this.bestLine.push([k, value]);
      this.best = k;
    });
    if (this.best >= 0) this.bestLine.push([kinds.length - 1, values[0][this.best]]);
  }

  #showStatus(status) {
    const ended = this.#running && status.state !== "running";
    this.status = status;
    this.#takeDriven(status.driven);
    const { state, reason, message, rollouts, budget, left, rate, solver, paused, interventions } = status;
    const method = this.trials.methods.at(-1);
    const waiting = interventions.filter(({ kind, batch }) => kind === "try" && batch === null).length;
    const states = { new: "not begun", running: paused ? "paused" : "running", ended: `ended (${reason})`, died: "its process has died" };
    if (JSON.stringify(this.parameters) !== JSON.stringify(status.parameters)) {
      this.parameters = status.parameters;
      this.#draw();
    }
    const facts = {
      state: states[state],
      rollouts: budget ? `${rollouts} of ${budget}` : `${rollouts}`,
      ...(left !== null && left !== undefined ? { left: duration(left) } : {}),
      ...(rate ? { rate: `${number(Math.round(rate * 10) / 10)} per s` } : {}),
      solver: method && method !== solver ? `${solver} (${method})` : solver,
      ...(waiting ? { waiting: `${waiting} points` } : {}),
      ...(this.best >= 0 && this.qualities.length === 1 ? { best: number(this.trials.values[0][this.best]) } : {}),
    };
    this.facts.replaceChildren(...Object.entries(facts).map(([name, text]) => element("span", { "data-fact": name, className: name === "state" ? state : "" }, element("small", {}, name), text)));
    if (message) this.say(message, "bad", "file");
    else this.takeBack("file");
    this.#showDeath(state);
    this.#showFailures();
    this.steering.show(status);
    this.#renewBest();
    if (ended) this.#draw(); // The model need not rest any more.
    document.body.dataset.state = state;
    document.body.dataset.rollouts = rollouts;
  }

  #takeDriven({ numbers, names, points, values, kinds, messages, after }) {
    const isSame = this.driven.length === numbers.length && this.driven.at(-1)?.number === numbers.at(-1);
    this.driven = numbers.map((number, k) => ({ number, name: names[k], point: points[k], values: values[k], kind: kinds[k], message: messages[k], after: after[k] }));
    if (isSame) return;
    document.body.dataset.driven = numbers.length;
    this.#draw();
  }

  // Marks of the rollouts that were driven by hand, each where `place` says; its index is -1 - number.
  #drivenMarks(place) {
    const marks = this.driven.map((drive) => ({ at: place(drive), tint: drive.kind === "feasible" ? DRIVEN : "#b2182b", shape: "diamond", index: -1 - drive.number }));
    return marks.filter(({ at }) => at.every((value) => value !== null));
  }

  // A drive may begin outside the ranges: its mark is then at the edge.
  #inside(value, k) {
    const { lower, upper, options } = this.parameters[k];
    return value === null || options ? value : Math.min(Math.max(value, lower), upper);
  }

  #showDeath(state) {
    if (state !== "died") return this.takeBack("died");
    if (this.told("died")) return;
    const told = this.say("the process that ran the study has died; what it had finished is kept. ", "bad", "died");
    if (!this.hello.command) {
      told.append("Run its program again to go on.");
      return;
    }
    told.append(
      element("button", { id: "vtb-resume", onclick: () => this.steering.run() }, "go on in a process of its own"),
      element("small", {}, " or: ", element("code", {}, this.hello.command)),
    );
  }

  #showFailures() {
    const rows = this.status.failures.map(([message, count, first]) =>
      element("tr", { onclick: () => first !== null && this.#pin(first) }, element("td", {}, `${count} ×`), element("td", {}, message || "no reason was recorded")),
    );
    const ends = Object.entries(this.status.ends).map(([end, count]) => `${end} ${count}`).join(", ");
    this.failures.replaceChildren(
      element("caption", {}, ends ? `rollouts ended by: ${ends}` : "no rollout has ended yet"),
      ...(rows.length ? rows : [element("tr", {}, element("td", {}, "no rollout has failed"))]),
    );
    this.tabs.querySelector("#vtb-tab-failures").textContent = rows.length ? `failures (${this.status.ends.failed})` : "failures";
  }

  #showTable() {
    const { values } = this.trials;
    const head = element("tr", {}, element("th", {}, "trial"), ...this.qualities.map(({ name }) => element("th", {}, name)), ...this.parameters.map(({ address }) => element("th", { title: address }, short(address))));
    const rows = this.ranking.slice(0, LISTED).map((k) =>
      element(
        "tr",
        { onclick: () => this.#pin(k), onmouseenter: () => this.point(k), className: k === this.shownBest ? "chosen" : "" },
        element("td", {}, k),
        ...this.qualities.map((_, q) => element("td", {}, number(values[q][k]))),
        ...this.trials.point(k).map((value, p) => element("td", {}, this.valueText(p, value))),
      ),
    );
    this.bestTable.replaceChildren(head, ...rows);
  }

  valueText(parameter, value) {
    const { options } = this.parameters[parameter];
    return options ? options[value] : number(value);
  }

  // -- charts

  scale(k, name = this.parameters[k].address) {
    const { unit, lower, upper, log, options } = this.parameters[k];
    return new Scale({ label: unit && unit !== "1" ? `${name} [${unit}]` : name, lower, upper, log, options });
  }

  valueScale(quality, label) {
    const finite = [...(this.trials.values[quality] ?? []), ...this.driven.map(({ values }) => values[quality])].filter((value) => value !== null);
    const [least, most] = extent(finite);
    const margin = 0.06 * (most - least);
    return new Scale({ label: label ?? this.qualities[quality].name, lower: least - margin, upper: most + margin });
  }

  // The shade of a value: by its rank, so that outliers leave colours for the rest.
  shades(quality) {
    const sorted = (this.trials.values[quality] ?? []).filter((value, k) => value !== null && this.trials.kinds[k] !== "dropped").sort((a, b) => a - b);
    return (value) => {
      if (value === null || !sorted.length) return NaN;
      let [low, high] = [0, sorted.length];
      while (low < high) {
        const middle = (low + high) >> 1;
        if (sorted[middle] < value) low = middle + 1;
        else high = middle;
      }
      const rank = sorted.length > 1 ? low / (sorted.length - 1) : 1;
      return this.sign[quality] > 0 ? rank : 1 - rank;
    };
  }

  redraw() {
    this.#findBest();
    this.#draw();
  }

  #draw() {
    if (!this.hello) return;
    const quality = this.qualities.length > 1 ? Number(this.quality.value) : 0;
    const { kinds: kind, values, points } = this.trials;
    const shade = (this.shadeOf[quality] ??= this.shades(quality));
    const common = { kind, best: this.best, color: (k) => color(shade(values[quality][k])) };
    if (this.view === "landscape") this.#drawLandscape(quality, shade, common);
    if (this.view === "parallel") {
      const order = kind.map((_, k) => k).sort((a, b) => (shade(values[quality][a]) || 0) - (shade(values[quality][b]) || 0));
      const scales = [...this.parameters.map(({ address }, k) => this.scale(k, short(address))), ...this.qualities.map((_, q) => this.valueScale(q))];
      const drives = this.#drivenMarks(({ point, values }) => [...point.map((value, k) => this.#inside(value, k)), ...values.map((value, q) => value ?? scales[point.length + q].lower)]);
      this.parallel.show({ ...common, columns: [...points, ...values], order, marks: drives }, scales);
    }
    if (this.view === "pareto") {
      const inFront = new Set(this.front);
      const tint = (k) => (inFront.has(k) ? "#d6604d" : "rgba(93,104,112,0.35)");
      const line = (this.front ?? []).map((k) => [values[0][k], values[1][k]]);
      this.pareto.show({ ...common, x: values[0] ?? [], y: values[1] ?? [], color: tint, line, marks: this.paretoMarks() }, this.valueScale(0), this.valueScale(1));
    }
    const many = this.trials.count;
    this.history.show(
      {
        ...common,
        x: kind.map((_, k) => k),
        y: values[quality] ?? [],
        line: quality === 0 ? this.bestLine : [],
        marks: this.#drivenMarks((drive) => [Math.min(drive.after, Math.max(many - 1, 0)), drive.values[quality]]),
      },
      new Scale({ label: "trial", lower: -0.02 * many - 0.5, upper: Math.max(1, 1.02 * many - 0.5) }),
      this.valueScale(quality),
    );
    this.#showTable();
  }

  paretoMarks() {
    const aim = this.status?.aspiration;
    return [
      ...this.#drivenMarks(({ values }) => values.slice(0, 2)),
      ...(this.tried ? [{ at: this.tried.values, tint: "#009e73", shape: "box" }] : []),
      ...(aim ? [{ at: aim, tint: "#0b6e99", shape: "target" }] : []),
    ];
  }

  #drawLandscape(quality, shade, common) {
    const { points, values } = this.trials;
    if (!this.parameters.length) return;
    const single = this.parameters.length === 1;
    const [x, y] = [Number(this.xAxis.value), single ? -1 : Number(this.yAxis.value)];
    const grid = this.grid && this.model.checked && this.grid.key === `${x} ${y} ${quality}` ? this.grid : null;
    const height = (point, value) => (single ? value : point[y]);
    const marks = this.#drivenMarks(({ point, values }) => [this.#inside(point[x], x), single ? values[quality] : this.#inside(point[y], y)]);
    if (this.tried) marks.push({ at: [this.tried.point[x], height(this.tried.point, this.tried.values[0])], tint: "#009e73", shape: "box" });
    if (!single && this.sections.try && !this.sections.try.hidden) marks.push({ at: [this.draft[x], this.draft[y]], tint: "#1c2329", shape: "cross" });
    this.landscape.show(
      { ...common, x: points[x] ?? [], y: (single ? values[quality] : points[y]) ?? [], grid, shade: (value) => color(shade(value), 0.55), marks, regions: single ? [] : this.steering.regions(x, y) },
      this.scale(x),
      single ? this.valueScale(quality) : this.scale(y),
    );
    if (!single && x !== y && this.model.checked) this.#askForModel(x, y, quality);
  }

  #askForModel(x, y, quality) {
    const key = `${x} ${y} ${quality}`, count = this.trials.count;
    const renews = this.grid?.key === key;
    if (this.best < 0 || this.asking || (renews && count < MODEL_GROWTH * this.grid.trials)) return;
    if (renews && this.#running && this.modelThrift.rests) return;
    this.asking = true;
    const address = (k) => this.parameters[k].address;
    this.ask("model", { x: address(x), y: address(y), quality, trial: this.shownBest ?? this.best })
      .then((grid) => {
        this.grid = { ...grid, key };
        this.asking = false;
        this.modelThrift.spent(grid.seconds);
        document.body.dataset.model = grid.trials;
        this.#draw();
      })
      .catch((error) => {
        this.grid = { key, trials: count };
        this.asking = false;
        this.say(`the model cannot be computed: ${error.message}`, "bad", "model");
      });
  }

  // -- rollouts

  // Shows the ghost of the trial that the pointer is at.
  point(k) {
    if (k === this.pointed) return;
    this.pointed = k;
    this.#describe(k);
    for (const chart of [...Object.values(this.views), this.history]) chart.point(k);
    this.wanted = k;
    this.pointTimer ??= setTimeout(() => {
      this.pointTimer = null;
      this.#showPointed();
    }, POINT_PERIOD);
  }

  #showPointed() {
    const k = this.wanted;
    if (!this.hello.simulates) return;
    if (k === -1) {
      this.#legend("pointed", false);
      return this.ask("hide", { role: "pointed" }).catch(() => {});
    }
    const source = k >= 0 ? { trial: k, condition: this.#condition } : { driven: -1 - k };
    this.ask("show", { role: "pointed", ...source })
      .then((shown) => {
        if (this.pointed !== k) return;
        this.#legend("pointed", true);
        this.#extend(shown.duration);
        document.body.dataset.pointed = k;
        const isTold = k >= 0 ? this.trials.kinds[k] === "failed" : shown.message === this.#drive(k)?.message;
        if (shown.message && !isTold) this.pointedText.append(` ${shown.message}`);
      })
      .catch((error) => k === this.pointed && this.pointedText.append(` ${error.message}`));
  }

  // The driven rollout of an index, which is -1 - its number.
  #drive(index) {
    return this.driven.find(({ number: its }) => its === -1 - index);
  }

  get #condition() {
    return Number(this.condition.value);
  }

  #describe(k) {
    if (k === -1) return (this.pointedText.textContent = "");
    const drive = this.#drive(k);
    if (k < -1 && !drive) return;
    const values = this.qualities.map(({ name }, q) => `${name} = ${number(drive ? drive.values[q] : this.trials.values[q][k])}`);
    const point = (drive?.point ?? this.trials.point(k)).map((value, p) => `${short(this.parameters[p].address)} ${this.valueText(p, value)}`);
    if (drive) return (this.pointedText.textContent = `driven by ${drive.name}: ${values.join(", ")}${drive.kind === "broken" ? " (breaks a constraint)" : ""}${drive.message && `, ${drive.message}`}; from ${point.join(", ")}`);
    const remark = { failed: ` failed: ${this.trials.reasons[k] ?? ""}`, broken: " (breaks a constraint)", dropped: " (dropped by racing)", feasible: "" }[this.trials.kinds[k]];
    this.pointedText.textContent = `trial ${k}${this.trials.byHand.has(k) ? ", by hand" : ""}: ${values.join(", ")}${remark}; ${point.join(", ")}`;
  }

  #click(k, values) {
    if (this.view === "landscape" && this.tryByClick.checked && !this.sections.try.hidden) {
      const [x, y] = [Number(this.xAxis.value), this.parameters.length > 1 ? Number(this.yAxis.value) : -1];
      this.setDraft(this.draft.map((old, i) => (i === x ? values[0] : i === y ? values[1] : old)));
      return this.attempt();
    }
    if (k >= 0) this.#pin(k);
  }

  // Shows a trial instead of the best, until the best itself is clicked.
  #pin(k) {
    if (k === undefined || k < 0) return;
    this.pinned = k !== this.best;
    this.#showBest(k);
    this.setDraft(this.trials.point(k));
  }

  #showBest(k) {
    this.shownBest = k;
    if (this.draftUntouched !== false) this.setDraft(this.trials.point(k), true);
    this.#showTable();
    if (!this.hello.simulates) return;
    this.ask("show", { role: "best", trial: k, condition: this.#condition })
      .then((shown) => {
        this.#legend("best", true, this.pinned ? `trial ${k}` : "best");
        this.#extend(shown.duration);
        this.bestThrift.spent(shown.seconds ?? 0);
        document.body.dataset.best = k;
        if (shown.message) this.say(shown.message, "bad");
      })
      .catch(() => {}); // Another one has been asked for meanwhile.
  }

  #legend(name, shown, text) {
    const key = document.getElementById(`vtb-key-${name}`);
    key.hidden = !shown;
    if (text) key.lastChild.textContent = text;
  }

  // -- points that are tried

  setDraft(point, untouched = false) {
    this.draft = point.map((value, k) => {
      const { lower, upper, integer, options } = this.parameters[k];
      if (options) return value;
      const inside = Math.min(Math.max(value, lower), upper);
      return integer ? Math.round(inside) : inside;
    });
    this.draftUntouched = untouched;
    this.tryInputs.forEach(({ update }) => update());
    this.#draw();
  }

  attempt() {
    if (!this.hello.simulates) return;
    this.tryResult.textContent = "simulating…";
    this.attempts = (this.attempts ?? 0) + 1;
    const attempt = this.attempts;
    return this.ask("try", { point: this.draft, condition: this.#condition })
      .then((tried) => {
        if (attempt !== this.attempts) return;
        this.tried = tried;
        const values = this.qualities.map(({ name }, q) => `${name} = ${number(tried.values[q])}`).join(", ");
        const best = this.best >= 0 && this.qualities.length === 1 ? ` (best: ${number(this.trials.values[0][this.best])})` : "";
        const remark = { failed: `failed: ${tried.message}`, broken: "breaks a constraint", feasible: "" }[tried.kind];
        this.tryResult.textContent = [values + best, remark].filter(Boolean).join("; ");
        this.tryResult.className = tried.kind === "feasible" ? "" : "bad";
        this.#legend("tried", true);
        this.#extend(tried.duration);
        this.#draw();
        document.body.dataset.tried = attempt;
      })
      .catch((error) => {
        this.tryResult.textContent = error.message;
        this.tryResult.className = "bad";
      });
  }

  #give() {
    this.ask("give", { point: this.draft })
      .then(() => this.say(this.status?.state === "running" ? "the study evaluates it with its next batch" : "it waits until the study goes on"))
      .catch((error) => this.say(error.message, "bad"));
  }

  // -- time

  #extend(seconds) {
    this.duration = Math.max(this.duration, seconds);
    this.slider.max = this.duration || 1;
  }

  setTime(time) {
    this.time = Math.min(Math.max(time, 0), this.duration);
    this.slider.value = this.time;
    this.clock.textContent = `${this.time.toFixed(2)} s`;
    if (!this.hello.simulates || this.timing) return;
    this.timing = true;
    this.ask("time", { time: this.time })
      .catch(() => {})
      .finally(() => {
        document.body.dataset.time = this.time;
        setTimeout(() => {
          this.timing = false;
          if (this.sentTime !== this.time) this.setTime(this.time);
        }, TIME_PERIOD);
      });
    this.sentTime = this.time;
  }

  play(playing) {
    this.playing = playing;
    this.playButton.textContent = playing ? "pause" : "play";
    if (!playing) return;
    let last = performance.now();
    if (this.time >= this.duration) this.setTime(0);
    const step = (now) => {
      if (!this.playing) return;
      this.setTime(this.time + (now - last) / 1000);
      last = now;
      if (this.time >= this.duration) return this.play(false);
      requestAnimationFrame(step);
    };
    requestAnimationFrame(step);
  }

  #key(event) {
    if (event.key !== " " || event.target.matches("input[type=text], select, button")) return;
    event.preventDefault();
    this.play(!this.playing);
  }
}

function extent(values) {
  let [least, most] = [Infinity, -Infinity];
  for (const value of values) {
    if (value < least) least = value;
    if (value > most) most = value;
  }
  return least <= most ? [least, most] : [0, 1];
}

// The trials of those that no other one beats in one quality without losing in another, along the first quality.
function paretoFront(candidates, values, sign) {
  const better = (a, b) => values.every((column, q) => sign[q] * column[a] >= sign[q] * column[b]) && values.some((column, q) => column[a] !== column[b]);
  const sorted = candidates.toSorted((a, b) => sign[0] * (values[0][b] - values[0][a]) || sign[1] * (values[1][b] - values[1][a]));
  const front = [];
  for (const k of sorted) if (!front.some((other) => better(other, k))) front.push(k);
  return front.sort((a, b) => values[0][a] - values[0][b]);
}

await Promise.all([load("link", { rel: "stylesheet", href: "page/view.css" }), load("link", { rel: "stylesheet", href: "page/study.css" })]);
window.vtb = new Page();
