// What a person changes in a study: its controls, its search, and the list of changes.

import { button, element, number } from "./common.js";

const CONTROLS = ["pause", "resume", "stop"]; // the points do not depend on these

export class Steering {
  constructor(page) {
    this.page = page;
    this.addresses = page.parameters.map(({ address }) => address);
    this.pauseButton = button("vtb-pause", "pause", "finish the batch, then ask for nothing", () => this.intervene(this.status.paused ? "resume" : "pause"));
    this.stopButton = button("vtb-stop", "stop", "end the run after its batch", () => this.intervene("stop"));
    this.runButton = button("vtb-run", "go on", `run it in a process of its own: ${page.hello.command}`, () => this.run());
    this.controls = element("span", { id: "vtb-controls" }, this.runButton, this.pauseButton, this.stopButton);
    this.rows = page.parameters.map((parameter) => this.#row(parameter));
    this.solver = element("select", { id: "vtb-solver", onchange: () => this.intervene("solver", { solver: this.solver.value }) }, ...page.hello.solvers.map((name) => element("option", {}, name)));
    this.budget = element("input", { id: "vtb-budget", type: "text", title: "rollouts that the study has in the end; empty: no limit", onchange: () => this.#setBudget() });
    this.forbidding = element("input", { id: "vtb-forbid", type: "checkbox" });
    this.forbidden = element("ul", { id: "vtb-forbidden" });
    this.search = element(
      "section",
      { id: "vtb-search" },
      ...this.rows.map(({ row }) => row),
      element("div", { className: "vtb-row" }, element("label", {}, "solver ", this.solver), element("label", {}, "rollouts ", this.budget)),
      page.parameters.length > 1 ? element("label", {}, this.forbidding, " a drag in the landscape forbids a region") : "",
      this.forbidden,
      page.qualities.length > 1
        ? element("p", {}, "A drag on the front sets what is aimed at. ", button("vtb-whole-front", "aim at the whole front", "", () => this.intervene("aspiration", { targets: null })))
        : "",
    );
    this.changes = element("table", { id: "vtb-changes" });
  }

  get forbids() {
    return this.forbidding.checked && !this.search.hidden;
  }

  intervene(kind, payload = {}) {
    return this.page.do("intervene", { kind, payload });
  }

  // Lets a process of its own go on with the study.
  run() {
    return this.page.do("run");
  }

  // One row per parameter: its range or options, and whether it is frozen.
  #row(parameter) {
    const { address, unit, options } = parameter;
    const input = (name) => element("input", { type: "text", "aria-label": `${address} ${name}`, onchange: (event) => this.#narrow(address, name, event.target) });
    const ends = options ? [] : [input("lower"), input("upper")];
    const boxes = (options ?? []).map((option) => element("input", { type: "checkbox", "aria-label": `${address} ${option}`, onchange: () => this.#choose(parameter, boxes) }));
    const frozen = element("input", { type: "checkbox", "aria-label": `${address} frozen`, onchange: () => this.#freeze(address, frozen.checked) });
    const text = element("span", { className: "vtb-frozen" });
    const row = element(
      "div",
      { className: "vtb-range", "data-address": address },
      element("label", { title: address }, `${address}${unit && unit !== "1" ? ` [${unit}]` : ""}`),
      ...ends,
      ...(options ? [element("span", { className: "vtb-options" }, ...options.map((option, k) => element("label", {}, boxes[k], ` ${option}`)))] : []),
      element("label", { title: "hold it at the value of the point under \"try\"" }, frozen, " frozen ", text),
    );
    return { row, ends, boxes, frozen, text, options };
  }

  #narrow(address, name, field) {
    const value = Number(field.value);
    if (field.value.trim() === "" || !Number.isFinite(value)) this.page.say(`the ${name} end of ${address} is a number`, "bad");
    else this.intervene("range", { address, [name]: value });
    field.blur();
    this.show(this.status);
  }

  #choose({ address, options }, boxes) {
    this.intervene("range", { address, options: options.filter((_, k) => boxes[k].checked) }).then(() => this.show(this.status));
  }

  #freeze(address, frozen) {
    const k = this.addresses.indexOf(address), value = this.page.draft[k], { options } = this.page.parameters[k];
    const done = frozen ? this.intervene("freeze", { address, value: options ? options[value] : value }) : this.intervene("unfreeze", { address });
    done.then(() => this.show(this.status));
  }

  #setBudget() {
    const text = this.budget.value.trim(), rollouts = text === "" ? null : Number(text);
    this.budget.blur();
    if (rollouts !== null && !Number.isInteger(rollouts)) this.page.say("a budget is a whole number of rollouts", "bad");
    else this.intervene("budget", { rollouts });
    this.show(this.status);
  }

  forbid(axes, from, to) {
    const region = {};
    axes.forEach((k, i) => {
      const { address, options } = this.page.parameters[k];
      const [low, high] = [Math.min(from[i], to[i]), Math.max(from[i], to[i])];
      region[address] = options ? options.slice(low, high + 1) : [low, high];
    });
    return this.intervene("forbid", { region });
  }

  // Aims at the values of two qualities; the others keep their targets, or those of the best trial.
  aim(values) {
    const { page } = this;
    const others = this.status.aspiration ?? page.qualities.map((_, q) => page.trials.values[q][page.best]);
    return this.intervene("aspiration", { targets: [...values, ...others.slice(2)] });
  }

  // Whether a point lies in a forbidden region; of a choice it has the number of the option.
  excludes(point) {
    return (this.status?.forbidden ?? []).some(([, region]) =>
      Object.entries(region).every(([address, side]) => {
        const k = this.addresses.indexOf(address), { options } = this.page.parameters[k];
        if (options) return side.includes(options[point[k]]);
        const [lower, upper] = side;
        return (lower === null || point[k] >= lower) && (upper === null || point[k] <= upper);
      }),
    );
  }

  // The forbidden regions over two parameters, as far as they are bounded by these alone: [x0, y0, x1, y1].
  regions(x, y) {
    const side = (region, k) => {
      const { address, lower, upper, options } = this.page.parameters[k], ends = region[address];
      if (!ends) return options ? [-0.5, options.length - 0.5] : [lower, upper];
      if (!options) return [ends[0] ?? lower, ends[1] ?? upper];
      const places = ends.map((option) => options.indexOf(option));
      return [Math.min(...places) - 0.5, Math.max(...places) + 0.5];
    };
    const shown = [this.page.parameters[x].address, this.page.parameters[y].address];
    return (this.status?.forbidden ?? [])
      .filter(([, region]) => Object.keys(region).every((address) => shown.includes(address)))
      .map(([, region]) => {
        const [[x0, x1], [y0, y1]] = [side(region, x), side(region, y)];
        return [x0, y0, x1, y1];
      });
  }

  show(status) {
    const before = JSON.stringify(this.status?.forbidden ?? []);
    this.status = status;
    const running = status.state === "running";
    this.pauseButton.textContent = status.paused ? "resume" : "pause";
    this.runButton.hidden = running || !this.page.hello.command;
    this.runButton.disabled = status.budget === null || status.rollouts >= status.budget;
    this.pauseButton.disabled = !running && !status.paused;
    this.stopButton.disabled = !running;
    this.rows.forEach(({ ends, boxes, frozen, text, options }, k) => {
      const range = status.ranges[k], address = this.addresses[k];
      ends.forEach((field, i) => {
        if (document.activeElement !== field) field.value = number(i ? range.upper : range.lower);
      });
      boxes.forEach((box, i) => (box.checked = range.options.includes(options[i])));
      frozen.checked = address in status.frozen;
      text.textContent = frozen.checked ? `at ${options ? status.frozen[address] : number(status.frozen[address])}` : "";
    });
    if (document.activeElement !== this.solver) this.solver.value = status.solver;
    if (document.activeElement !== this.budget) this.budget.value = status.budget ?? "";
    this.forbidden.replaceChildren(
      ...status.forbidden.map(([place, region]) =>
        element("li", {}, `forbidden: ${regionText(region)} `, element("button", { onclick: () => this.intervene("allow", { number: place }) }, "allow")),
      ),
    );
    this.#showChanges(status.interventions);
    document.body.dataset.interventions = status.interventions.length;
    document.body.dataset.effective = status.interventions.filter(({ batch }) => batch !== null).length;
    if (JSON.stringify(status.forbidden) !== before || status.interventions.length !== this.listed) this.page.redraw();
    this.listed = status.interventions.length;
  }

  #showChanges(interventions) {
    const rows = [...interventions].reverse().map(({ number: place, time, name, kind, text, batch }) =>
      element(
        "tr",
        {},
        element("td", {}, place),
        element("td", { title: time }, new Date(time).toTimeString().slice(0, 8)),
        element("td", {}, name),
        element("td", {}, text),
        element("td", {}, ...(batch === null ? [this.#takeBack(place)] : [`since batch ${batch} `, this.#undo(place, kind)])),
      ),
    );
    this.changes.replaceChildren(...(rows.length ? rows : [element("tr", {}, element("td", {}, "nothing has been changed"))]));
  }

  #takeBack(place) {
    return element("button", { title: "it has had no effect yet", onclick: () => this.page.do("remove", { number: place }) }, "take back");
  }

  // What has had an effect is undone by a study of its own, which repeats this one without it.
  #undo(place, kind) {
    const { replay } = this.page.hello;
    if (!replay || CONTROLS.includes(kind)) return "";
    const tell = () => this.page.note(`repeat the study without it: ${replay} ${place}`, "undo");
    return element("button", { onclick: tell }, "undo");
  }
}

const valueText = (value) => (typeof value === "number" ? number(value) : value === null ? "open" : String(value));

const regionText = (region) => Object.entries(region).map(([address, side]) => `${address} ${side.map(valueText).join(" to ")}`).join(", ");
