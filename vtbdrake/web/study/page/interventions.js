// What a person changes in a study: its controls, its search, and the list of changes.

import { button, choice, element, isHeld, number, replaceContent } from "./common.js";

const CONTROLS = ["pause", "resume", "stop"]; // the points do not depend on these

export class Interventions {
  /** @type {any} */
  status = null;
  /** @type {number | undefined} */
  listed;
  #asked = 0; // changes that are on their way to the server
  #latest = 0; // number of the last one that it has taken, as long as no status has told it

  /** @param {any} page of the study */
  constructor(page) {
    this.page = page;
    /** @type {any[]} */
    const parameters = page.parameters;
    /** @type {string[]} */
    this.addresses = parameters.map(({ address }) => address);
    this.pauseButton = button("vtb-pause", "pause", "finish the batch, then ask for nothing", () =>
      this.intervene(this.status.paused ? "resume" : "pause"),
    );
    this.stopButton = button("vtb-stop", "stop", "end the run after its batch", () => this.intervene("stop"));
    this.runButton = button("vtb-run", "go on", `run it in a process of its own: ${page.hello.command}`, () =>
      this.run(),
    );
    this.controls = element("span", { id: "vtb-controls" }, this.runButton, this.pauseButton, this.stopButton);
    for (const control of [this.runButton, this.pauseButton, this.stopButton])
      page.allow(control, "where the study stands is not known yet");
    this.rows = parameters.map((parameter) => this.#row(parameter));
    this.solver = choice(
      { id: "vtb-solver" },
      (solver) => this.intervene("solver", { solver }),
      ...page.hello.solvers.map((/** @type {string} */ name) => element("option", {}, name)),
    );
    this.budget = element("input", {
      id: "vtb-budget",
      type: "text",
      title: "rollouts that the study has in the end; empty: no limit",
      onchange: () => this.#setBudget(),
    });
    this.forbidding = element("input", { id: "vtb-forbid", type: "checkbox" });
    this.sides = page.parameters.length > 1 ? [0, 1].map(() => element("input", { type: "text" })) : [];
    this.forbidden = element("ul", { id: "vtb-forbidden" });
    this.search = element(
      "section",
      { id: "vtb-search" },
      ...this.rows.map(({ row }) => row),
      element(
        "div",
        { className: "vtb-row" },
        element("label", {}, "solver ", this.solver),
        element("label", {}, "rollouts ", this.budget),
      ),
      page.parameters.length > 1 ? this.#regionForm() : "",
      this.forbidden,
      page.qualities.length > 1 ? this.#aimForm() : "",
    );
    this.changes = element("table", { id: "vtb-changes" });
  }

  // A region over the parameters of the landscape, by a drag or by numbers.
  #regionForm() {
    const forbid = () => {
      const { axes } = this.page.charts;
      const sides = axes
        .map((/** @type {number} */ k, /** @type {number} */ i) => [
          this.addresses[k],
          this.#side(k, this.sides[i].value),
        ])
        .filter((/** @type {[string, any]} */ [, side]) => side);
      return this.intervene("forbid", { region: Object.fromEntries(sides) });
    };
    return element(
      "div",
      {},
      element("label", {}, this.forbidding, " a drag in the landscape forbids a region"),
      element(
        "div",
        { className: "vtb-row" },
        ...this.sides,
        button("vtb-forbid-region", "forbid", "ask for no more points in this region", forbid),
      ),
    );
  }

  /** Names the sides of a region after the axes of the landscape. */
  nameSides() {
    this.sides.forEach((field, i) => {
      const k = this.page.charts.axes[i];
      const { options } = this.page.parameters[k];
      field.placeholder = `${this.page.parameterLabel(k)}: ${options ? options.join(", ") : "from, to"}`;
      field.ariaLabel = `forbidden ${this.addresses[k]}`;
    });
  }

  /**
   * @param {number} k a parameter
   * @param {string} text two numbers, or options
   * @returns {any[] | null} its side of a region; null for the whole range
   */
  #side(k, text) {
    const { options } = this.page.parameters[k];
    const words = text.split(/[\s,;]+/).filter(Boolean);
    if (!words.length) return null;
    if (options) return options.filter((/** @type {any} */ option) => words.includes(String(option)));
    return words.map((word) => (Number.isFinite(Number(word)) ? Number(word) : word));
  }

  // What is aimed at on the front: by a drag, or by numbers.
  #aimForm() {
    const { page } = this;
    const fields = page.qualities.map((/** @type {any} */ _, /** @type {number} */ q) =>
      element("input", {
        type: "text",
        placeholder: page.qualityLabel(q),
        ariaLabel: `aim of ${page.qualityLabel(q)}`,
      }),
    );
    const aim = () => {
      const targets = fields.map((/** @type {HTMLInputElement} */ { value }) => (value.trim() ? Number(value) : NaN));
      if (targets.every(Number.isFinite)) return this.intervene("aspiration", { targets });
      return page.say("an aim is a number for each quality", "bad");
    };
    return element(
      "div",
      {},
      element("p", {}, "A drag on the Pareto front, or numbers, set what is aimed at."),
      element(
        "div",
        { className: "vtb-row" },
        ...fields,
        button("vtb-aim", "aim", "what the next batches aim at", aim),
        button("vtb-whole-front", "aim at the whole front", "", () => this.intervene("aspiration", { targets: null })),
      ),
    );
  }

  get forbids() {
    return this.forbidding.checked && !this.search.hidden;
  }

  /**
   * Asks for a change; the controls show what the study does about it from then on.
   *
   * @param {string} kind
   */
  async intervene(kind, payload = {}) {
    this.#asked += 1;
    const place = await this.page.do("intervene", { kind, payload });
    this.#asked -= 1;
    if (place === undefined) this.#showControls();
    else this.#latest = place;
  }

  /** @param {number} place of the change that is taken back */
  async #remove(place) {
    if ((await this.page.do("remove", { number: place })) !== undefined) this.#latest = 0;
  }

  // A status from before a change would take back what a person has set meanwhile.
  get #isBehind() {
    return !this.status || this.#asked > 0 || this.#latest > 0;
  }

  // Lets a process of its own go on with the study.
  run() {
    return this.page.do("run");
  }

  /**
   * @param {any} parameter
   * @returns the row of a parameter: its range or options, and whether it is frozen
   */
  #row(parameter) {
    const { address, unit, options } = parameter;
    const input = (/** @type {string} */ name) =>
      element("input", {
        type: "text",
        "aria-label": `${address} ${name}`,
        onchange: (/** @type {any} */ event) => this.#narrow(address, name, event.target),
      });
    const ends = options ? [] : [input("lower"), input("upper")];
    /** @type {HTMLInputElement[]} */
    const boxes = (options ?? []).map((/** @type {any} */ option) =>
      element("input", {
        type: "checkbox",
        "aria-label": `${address} ${option}`,
        onchange: () => this.#choose(parameter, boxes),
      }),
    );
    const frozen = element("input", {
      type: "checkbox",
      "aria-label": `${address} frozen`,
      onchange: () => this.#freeze(address, frozen.checked),
    });
    const text = element("span", { className: "vtb-frozen" });
    const row = element(
      "div",
      { className: "vtb-range", "data-address": address },
      element("label", { title: address }, `${address}${unit && unit !== "1" ? ` [${unit}]` : ""}`),
      ...ends,
      ...(options
        ? [
            element(
              "span",
              { className: "vtb-options" },
              ...boxes.map((box, k) => element("label", {}, box, ` ${options[k]}`)),
            ),
          ]
        : []),
      element("label", { title: 'hold it at the value of the point under "try"' }, frozen, " frozen ", text),
    );
    return { row, ends, boxes, frozen, text, options };
  }

  /**
   * @param {string} address
   * @param {string} name of an end
   * @param {HTMLInputElement} field
   */
  #narrow(address, name, field) {
    const value = Number(field.value);
    if (field.value.trim() === "" || !Number.isFinite(value))
      this.page.say(`the ${name} end of ${address} is a number`, "bad");
    else this.intervene("range", { address, [name]: value });
    field.blur();
    this.#showControls();
  }

  /**
   * @param {any} parameter
   * @param {HTMLInputElement[]} boxes of its options
   */
  #choose({ address, options }, boxes) {
    const chosen = options.filter((/** @type {any} */ _, /** @type {number} */ k) => boxes[k].checked);
    this.intervene("range", { address, options: chosen });
  }

  /**
   * @param {string} address
   * @param {boolean} frozen
   */
  #freeze(address, frozen) {
    const k = this.addresses.indexOf(address),
      value = this.page.attempts.draft[k],
      { options } = this.page.parameters[k];
    if (frozen) this.intervene("freeze", { address, value: options ? options[value] : value });
    else this.intervene("unfreeze", { address });
  }

  #setBudget() {
    const text = this.budget.value.trim(),
      rollouts = text === "" ? null : Number(text);
    this.budget.blur();
    if (rollouts !== null && !Number.isInteger(rollouts))
      this.page.say("a budget is a whole number of rollouts", "bad");
    else this.intervene("budget", { rollouts });
    this.#showControls();
  }

  /**
   * @param {number[]} axes the parameters
   * @param {number[]} from a corner of the region
   * @param {number[]} to the opposite corner
   */
  forbid(axes, from, to) {
    /** @type {Record<string, any[]>} */
    const region = {};
    axes.forEach((k, i) => {
      const { address, options } = this.page.parameters[k];
      const [low, high] = [Math.min(from[i], to[i]), Math.max(from[i], to[i])];
      region[address] = options ? options.slice(low, high + 1) : [low, high];
    });
    return this.intervene("forbid", { region });
  }

  /** @param {number[]} values of two qualities; the others keep their targets, or the best trial's values */
  aim(values) {
    const { best, values: columns } = this.page.trials;
    const others = this.status.aspiration ?? columns.map((/** @type {number[]} */ column) => column[best]);
    return this.intervene("aspiration", { targets: [...values, ...others.slice(2)] });
  }

  /**
   * @param {number} x a parameter
   * @param {number} y another one
   * @returns {number[][]} the forbidden regions over them, as far as these alone bound them: [x0, y0, x1, y1]
   */
  regions(x, y) {
    /** @type {(region: Record<string, any[]>, k: number) => number[]} */
    const side = (region, k) => {
      const { address, lower, upper, options } = this.page.parameters[k],
        ends = region[address];
      if (!ends) return options ? [-0.5, options.length - 0.5] : [lower, upper];
      if (!options) return [ends[0] ?? lower, ends[1] ?? upper];
      const places = ends.map((option) => options.indexOf(option));
      return [Math.min(...places) - 0.5, Math.max(...places) + 0.5];
    };
    const shown = [this.page.parameters[x].address, this.page.parameters[y].address];
    /** @type {[number, Record<string, any[]>][]} */
    const forbidden = this.status?.forbidden ?? [];
    return forbidden
      .filter(([, region]) => Object.keys(region).every((address) => shown.includes(address)))
      .map(([, region]) => {
        const [[x0, x1], [y0, y1]] = [side(region, x), side(region, y)];
        return [x0, y0, x1, y1];
      });
  }

  /** @param {any} status where the study stands */
  show(status) {
    const before = JSON.stringify(this.status?.forbidden ?? []);
    this.status = status;
    if (status.interventions.at(-1)?.number >= this.#latest) this.#latest = 0;
    const running = status.state === "running";
    this.pauseButton.textContent = status.paused ? "resume" : "pause";
    this.runButton.hidden = running || !this.page.hello.command;
    const spent = `all ${status.budget} rollouts that were asked for are done: ask for more under search`;
    const unlimited = "the study has no budget of rollouts: give it one under search";
    const isSpent = status.rollouts >= status.budget;
    this.page.allow(this.runButton, status.budget === null ? unlimited : isSpent ? spent : "");
    const idle = "no process runs the study: go on first";
    this.page.allow(this.pauseButton, running || status.paused ? "" : idle);
    this.page.allow(this.stopButton, running ? "" : idle);
    this.#showControls();
    replaceContent(
      this.forbidden,
      ...status.forbidden.map((/** @type {[number, Record<string, any[]>]} */ [place, region]) =>
        element(
          "li",
          {},
          `forbidden: ${regionText(region)} `,
          element("button", { onclick: () => this.intervene("allow", { number: place }) }, "allow"),
        ),
      ),
    );
    this.#showChanges(status.interventions);
    const effective = status.interventions.filter((/** @type {any} */ { batch }) => batch !== null);
    document.body.dataset.interventions = status.interventions.length;
    document.body.dataset.effective = effective.length;
    if (JSON.stringify(status.forbidden) !== before || status.interventions.length !== this.listed) this.page.draw();
    this.listed = status.interventions.length;
  }

  // Shows how the search is set, but for what is just being set.
  #showControls() {
    const { status } = this;
    if (this.#isBehind) return;
    this.rows.forEach(({ ends, boxes, frozen, text, options }, k) => {
      const range = status.ranges[k],
        address = this.addresses[k];
      ends.forEach((field, i) => {
        if (document.activeElement !== field) field.value = number(i ? range.upper : range.lower);
      });
      boxes.forEach((box, i) => (box.checked = range.options.includes(options[i])));
      frozen.checked = address in status.frozen;
      text.textContent = frozen.checked
        ? `at ${options ? status.frozen[address] : number(status.frozen[address])}`
        : "";
    });
    if (!isHeld(this.solver)) this.solver.value = status.solver;
    if (document.activeElement !== this.budget) this.budget.value = status.budget ?? "";
  }

  /** @param {any[]} interventions */
  #showChanges(interventions) {
    const rows = [...interventions]
      .reverse()
      .map(({ number: place, time, name, kind, text, batch }) =>
        element(
          "tr",
          {},
          element("td", {}, place),
          element("td", { title: time }, new Date(time).toTimeString().slice(0, 8)),
          element("td", {}, name),
          element("td", {}, text),
          element(
            "td",
            {},
            ...(batch === null ? [this.#takeBack(place)] : [`since batch ${batch} `, this.#undo(place, kind)]),
          ),
        ),
      );
    replaceContent(
      this.changes,
      ...(rows.length ? rows : [element("tr", {}, element("td", {}, "nothing has been changed"))]),
    );
  }

  /** @param {number} place */
  #takeBack(place) {
    return element("button", { title: "it has had no effect yet", onclick: () => this.#remove(place) }, "take back");
  }

  /**
   * What has had an effect is undone by a study of its own, which repeats this one without it.
   *
   * @param {number} place
   * @param {string} kind
   */
  #undo(place, kind) {
    const { replay } = this.page.hello;
    if (!replay || CONTROLS.includes(kind)) return "";
    const tell = () => this.page.note(`repeat the study without it: ${replay} ${place}`, "undo");
    return element("button", { onclick: tell }, "undo");
  }
}

/** @param {any} value */
const valueText = (value) => (typeof value === "number" ? number(value) : value === null ? "open" : String(value));

/** @param {Record<string, any[]>} region */
const regionText = (region) =>
  Object.entries(region)
    .map(([address, side]) => `${address} ${side.map(valueText).join(" to ")}`)
    .join(", ");
