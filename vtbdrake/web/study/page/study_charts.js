// The charts of a study: a landscape over two parameters, slices, importances, all parameters side by side, two
// qualities, and the history; with what their colours and symbols mean.

import { Parallel, Scatter } from "./charts.js";
import { element } from "./common.js";
import { Importance } from "./importance.js";
import { ColorBar, Legend } from "./legend.js";
import { palette, shade } from "./palette.js";
import { Scale } from "./scale.js";
import { Slices } from "./slices.js";
import { Computed } from "./thrift.js";

const BEHIND_FRONT = "rgba(128,138,146,0.5)";

/**
 * @typedef {import("./charts.js").Pointed} Pointed
 * @typedef {import("./charts.js").Mark} Mark
 */

export class StudyCharts {
  view = "landscape";
  /** @type {Record<number, (value: number | null) => number>} */
  #shadeOf = {};

  /** @param {any} page whose study is drawn */
  constructor(page) {
    this.page = page;
    const { qualities } = page;
    this.labels = page.parameters.map((/** @type {any} */ _, /** @type {number} */ k) => page.parameterLabel(k));
    const several = this.labels.length > 1;
    const ask = (/** @type {string} */ command, /** @type {object} */ fields) => page.ask(command, fields);
    this.model = new Computed(ask, () => {
      if (this.model.result) document.body.dataset.model = this.model.result.trials;
      this.draw();
    });
    this.importances = new Computed(ask, () => this.draw());
    const onpoint = (/** @type {Pointed} */ pick) => page.rollouts.point(pick);
    const onkeep = (/** @type {Pointed} */ pick) => pick?.trial !== undefined && page.rollouts.pin(pick.trial);
    const events = { height: 0.3, onpoint, onkeep };
    this.landscape = new Scatter("vtb-landscape", {
      ...events,
      title: several ? "trials over two parameters" : "values of the trials over the parameter",
      onclick: (pick, values) => this.#click(pick, values),
      drags: () => (page.interventions.forbids && several ? "box" : ""),
      ondrag: (from, to) => page.interventions.forbid(this.axes, from, to),
    });
    this.slices = new Slices(this.labels, { ...events, height: 0.22, title: "" });
    this.importance = new Importance();
    this.parallel = new Parallel("vtb-parallel", { ...events, title: "all parameters and values side by side" });
    this.pareto = new Scatter("vtb-pareto", {
      ...events,
      title: "two qualities of the trials",
      drags: () => "target",
      ondrag: (_, to) => page.interventions.aim(to),
    });
    this.history = new Scatter("vtb-history-chart", {
      ...events,
      height: 0.17,
      title: "values in the order of trials",
    });
    this.views = {
      landscape: this.landscape,
      slices: this.slices,
      importance: this.importance,
      parallel: this.parallel,
      pareto: this.pareto,
    };
    this.xAxis = this.#choice("vtb-x", "horizontal axis", this.labels, 0);
    const vertical = several ? this.labels : ["value"];
    this.yAxis = this.#choice("vtb-y", "vertical axis", vertical, Math.min(1, this.labels.length - 1));
    const names = qualities.map((/** @type {any} */ _, /** @type {number} */ q) => page.qualityText(q));
    this.quality = this.#choice("vtb-quality", "quality", names, 0);
    this.modelBox = element("input", { type: "checkbox", id: "vtb-model", checked: true, onchange: () => this.draw() });
    const modelLabel = element("label", {}, this.modelBox, " model");
    const chosenQuality = qualities.length > 1 ? this.quality : "";
    this.selectors = element("div", { className: "vtb-row" }, this.xAxis, this.yAxis, chosenQuality, modelLabel);
    this.remark = element("output", { id: "vtb-remark" });
    this.colors = new ColorBar();
    this.legend = new Legend();
    this.switch = this.#tabs(several, qualities.length > 1);
  }

  /** @returns {number[]} the numbers of the parameters of the landscape's axes */
  get axes() {
    return [Number(this.xAxis.value), Number(this.yAxis.value)];
  }

  /** @returns {number} the number of the quality that is drawn */
  get chosenQuality() {
    return this.page.qualities.length > 1 ? Number(this.quality.value) : 0;
  }

  /**
   * @param {boolean} several whether there are several parameters
   * @param {boolean} hasFront whether there are several qualities
   * @returns {HTMLElement} the views that say something about this study
   */
  #tabs(several, hasFront) {
    const offered = [["landscape", several ? "landscape" : "values"]];
    if (several) offered.push(["slices", "slices"], ["importance", "importance"]);
    if (this.labels.length > 2) offered.push(["parallel", "parallel"]);
    if (hasFront) offered.push(["pareto", "pareto"]);
    const tabs = offered.map(([name, text]) =>
      element("button", { id: `vtb-view-${name}`, onclick: () => this.choose(name) }, text),
    );
    return element("nav", { className: "vtb-tabs", ariaLabel: "charts" }, ...tabs);
  }

  /**
   * @param {string} id
   * @param {string} title
   * @param {string[]} texts
   * @param {number} value the number of the text that is chosen at first
   */
  #choice(id, title, texts, value) {
    const options = texts.map((text, k) => element("option", { value: k, selected: k === value }, text));
    return element("select", { id, title, ariaLabel: title, onchange: () => this.draw() }, ...options);
  }

  /** @param {string} name of a view */
  choose(name) {
    this.view = name;
    for (const [key, chart] of Object.entries(this.views)) chart.element.hidden = key !== name;
    for (const tab of this.switch.children) {
      tab.classList.toggle("chosen", tab.id === `vtb-view-${name}`);
      tab.setAttribute("aria-pressed", String(tab.id === `vtb-view-${name}`));
    }
    this.selectors.hidden = name === "pareto";
    const several = this.labels.length > 1;
    this.xAxis.hidden = name !== "landscape" || !several;
    for (const part of [this.yAxis, this.modelBox.parentElement]) part.hidden = name !== "landscape" || !several;
    this.draw();
  }

  /** @param {Pointed} pick what the pointer is at, which all charts mark */
  point(pick) {
    for (const chart of [this.landscape, this.slices, this.parallel, this.pareto, this.history]) chart.point(pick);
  }

  // The trials have changed.
  renew() {
    this.#shadeOf = {};
  }

  /**
   * @param {Pointed} pick
   * @param {number[]} values
   */
  #click(pick, values) {
    const { attempts, rollouts } = this.page;
    if (this.view === "landscape" && attempts.tryByClick) {
      const [x, y] = [this.axes[0], this.labels.length > 1 ? this.axes[1] : -1];
      attempts.setDraft(
        attempts.draft.map((/** @type {number} */ before, /** @type {number} */ i) =>
          i === x ? values[0] : i === y ? values[1] : before,
        ),
      );
      attempts.attempt();
    } else if (pick?.trial !== undefined) rollouts.pin(pick.trial);
  }

  /**
   * @param {number} quality
   * @param {string} [label]
   * @returns {Scale} the scale of its values
   */
  valueScale(quality, label = this.page.qualityText(quality)) {
    const { trials, drives } = this.page;
    const driven = drives.drives.map((/** @type {any} */ { values }) => values[quality]);
    const [least, most] = extent([...(trials.values[quality] ?? []), ...driven].filter((value) => value !== null));
    const margin = 0.06 * (most - least);
    return new Scale({ label, lower: least - margin, upper: most + margin });
  }

  /**
   * @param {number | null} value
   * @param {number} k the parameter
   * @returns {number | null} a place of its axis: a drive may begin outside the ranges, its mark is then at the edge
   */
  #inside(value, k) {
    const { lower, upper, options } = this.page.parameters[k];
    return value === null || options ? value : Math.min(Math.max(value, lower), upper);
  }

  draw() {
    const { trials } = this.page;
    const quality = this.chosenQuality;
    const shadeOf = (this.#shadeOf[quality] ??= trials.shades(quality));
    const color = (/** @type {number} */ k) => shade(shadeOf(trials.values[quality][k]));
    const common = { kind: trials.kinds, best: trials.best, color };
    this.remark.textContent = "";
    if (this.view === "landscape") this.#drawLandscape(quality, shadeOf, common);
    if (this.view === "slices") this.#drawSlices(quality, common);
    if (this.view === "importance") this.#drawImportance(quality);
    if (this.view === "parallel") this.#drawParallel(quality, shadeOf, common);
    if (this.view === "pareto") this.#drawPareto(common);
    this.#drawHistory(quality, common);
    this.#explainColors(quality);
    this.#explainSymbols(quality);
    this.page.interventions.nameSides();
    this.page.table.renewed();
  }

  /**
   * Tells what the colours mean.
   *
   * @param {number} quality
   */
  #explainColors(quality) {
    const { page, view } = this;
    this.colors.element.hidden = view === "importance";
    if (view === "importance") return;
    if (view === "slices") {
      const last = Math.max(0, page.trials.count - 1);
      this.colors.show("order of the trials", [...Array(last + 1).keys()]);
      return;
    }
    const sorted = page.trials.sorted(quality);
    if (page.qualities[quality].minimize) sorted.reverse();
    this.colors.show(`${page.qualityText(quality)}: brighter is better, by rank`, sorted);
  }

  /**
   * Tells what the symbols mean that are there.
   *
   * @param {number} quality
   */
  #explainSymbols(quality) {
    const { page, view } = this;
    const { trials, drives, attempts, hello, status } = page;
    const kinds = new Set(trials.kinds);
    const isLine = view === "parallel";
    const isFront = view === "pareto";
    const hasBest = trials.best >= 0;
    const hasLine = isLine ? hasBest : quality === 0 && trials.bestLine.length > 0;
    const isOver = view === "landscape" && this.labels.length > 1;
    /** @type {[string, string, boolean][]} */
    const items = [
      ["front", "Pareto front", isFront],
      ["feasible", hello.constraints.length ? "keeps the constraints" : "trial", !isFront && kinds.has("feasible")],
      ["broken", "breaks a constraint", kinds.has("broken")],
      ["dropped", "dropped by racing", kinds.has("dropped")],
      ["failed", "failed", kinds.has("failed")],
      ["best", `${page.bestText}, trial ${trials.best}`, hasBest],
      ["line", isLine ? page.bestText : "best so far", hasLine],
      ["driven", "driven by hand", drives.drives.length > 0],
      ["tried", "tried here", attempts.tried !== null && (view === "landscape" || isFront)],
      ["draft", "sliders of try", isOver && !attempts.section.hidden],
      ["aim", "aim", isFront && Boolean(status?.aspiration)],
    ];
    this.legend.show(items.filter(([, , isShown]) => isShown).map(([symbol, text]) => [symbol, text]));
  }

  /**
   * @param {number} quality
   * @param {(value: number | null) => number} shadeOf
   * @param {object} common
   */
  #drawLandscape(quality, shadeOf, common) {
    const { page } = this;
    const { points, values } = page.trials;
    if (!page.parameters.length) return;
    const single = page.parameters.length === 1;
    const [x, y] = [this.axes[0], single ? -1 : this.axes[1]];
    const key = `${x} ${y} ${quality}`;
    const grid = this.modelBox.checked && !single ? this.model.of(key) : null;
    const data = {
      ...common,
      x: points[x] ?? [],
      y: (single ? values[quality] : points[y]) ?? [],
      grid,
      shade: (/** @type {number} */ value) => shade(shadeOf(value), 0.55),
      marks: this.#landscapeMarks(x, y, quality),
      regions: single ? [] : page.interventions.regions(x, y),
    };
    this.landscape.show(data, page.scale(x), single ? this.valueScale(quality) : page.scale(y));
    if (!single && x !== y && this.modelBox.checked) this.#wantModel(key, x, y, quality);
  }

  /**
   * @param {string} key
   * @param {number} x
   * @param {number} y
   * @param {number} quality
   */
  #wantModel(key, x, y, quality) {
    const { page } = this;
    this.remark.textContent = this.model.error || this.model.of(key)?.remark || "";
    if (page.trials.best < 0) return;
    const address = (/** @type {number} */ k) => page.parameters[k].address;
    const trial = page.rollouts.shown >= 0 ? page.rollouts.shown : page.trials.best;
    const fields = { x: address(x), y: address(y), quality, trial };
    this.model.want(key, "model", fields, { trials: page.trials.count, running: page.isRunning });
  }

  /**
   * @param {number} x
   * @param {number} y the vertical parameter; -1 for the quality
   * @param {number} quality
   * @returns {Mark[]} the marks of drives, of what was tried, and of the draft
   */
  #landscapeMarks(x, y, quality) {
    const { drives, attempts } = this.page;
    const { tried, draft, section } = attempts;
    const single = y < 0;
    const marks = drives.marks((/** @type {any} */ { point, values }) => [
      this.#inside(point[x], x),
      single ? values[quality] : this.#inside(point[y], y),
    ]);
    if (tried) {
      const height = single ? tried.values[0] : tried.point[y];
      marks.push({ at: [tried.point[x], height], tint: palette.tried, shape: "box", pick: null });
    }
    if (!single && !section.hidden) {
      marks.push({ at: [draft[x], draft[y]], tint: palette.ink, shape: "cross", pick: null });
    }
    return marks;
  }

  /**
   * @param {number} quality
   * @param {object} common
   */
  #drawSlices(quality, common) {
    const { page } = this;
    const { points, values } = page.trials;
    const scales = this.labels.map((/** @type {string} */ label, /** @type {number} */ k) => page.scale(k, label));
    this.slices.show(common, { points, values: values[quality] ?? [] }, scales, this.valueScale(quality));
  }

  /** @param {number} quality */
  #drawImportance(quality) {
    const { page } = this;
    const key = String(quality);
    this.remark.textContent = this.importances.error;
    const labels = new Map(
      page.parameters.map((/** @type {any} */ { address }, /** @type {number} */ k) => [address, k]),
    );
    this.importance.element.hidden = Boolean(this.importances.error);
    this.importance.show(page.qualityLabel(quality), this.importances.of(key), (address) =>
      page.parameterLabel(labels.get(address)),
    );
    this.importances.want(key, "importance", { quality }, { trials: page.trials.count, running: page.isRunning });
  }

  /**
   * @param {number} quality
   * @param {(value: number | null) => number} shadeOf
   * @param {object} common
   */
  #drawParallel(quality, shadeOf, common) {
    const { page } = this;
    const { kinds, points, values } = page.trials;
    const height = (/** @type {number} */ k) => shadeOf(values[quality][k]) || 0;
    const order = kinds
      .map((/** @type {string} */ _, /** @type {number} */ k) => k)
      .sort((/** @type {number} */ a, /** @type {number} */ b) => height(a) - height(b));
    const scales = [
      ...this.labels.map((/** @type {string} */ label, /** @type {number} */ k) => page.scale(k, label)),
      ...page.qualities.map((/** @type {any} */ _, /** @type {number} */ q) =>
        this.valueScale(q, page.qualityArrow(q)),
      ),
    ];
    const marks = page.drives.marks((/** @type {any} */ { point, values: reached }) => [
      ...point.map((/** @type {number | null} */ value, /** @type {number} */ k) => this.#inside(value, k)),
      ...reached.map(
        (/** @type {number | null} */ value, /** @type {number} */ q) => value ?? scales[point.length + q].lower,
      ),
    ]);
    this.parallel.show({ ...common, columns: [...points, ...values], order, marks }, scales);
  }

  /** @param {object} common */
  #drawPareto(common) {
    const { page } = this;
    const { front, values } = page.trials;
    const inFront = new Set(front);
    const marks = page.drives.marks((/** @type {any} */ { values: reached }) => reached.slice(0, 2));
    const { tried } = page.attempts;
    const aim = page.status?.aspiration;
    if (tried) marks.push({ at: tried.values, tint: palette.tried, shape: "box", pick: null });
    if (aim) marks.push({ at: aim, tint: palette.aim, shape: "target", pick: null });
    const line = front.map((/** @type {number} */ k) => [values[0][k], values[1][k]]);
    const tint = (/** @type {number} */ k) => (inFront.has(k) ? palette.best : BEHIND_FRONT);
    const data = { ...common, x: values[0] ?? [], y: values[1] ?? [], color: tint, line, marks };
    this.pareto.show(data, this.valueScale(0), this.valueScale(1));
  }

  /**
   * @param {number} quality
   * @param {object} common
   */
  #drawHistory(quality, common) {
    const { trials, drives } = this.page;
    const { count, values, bestLine } = trials;
    const place = (/** @type {any} */ { after, values: reached }) => [
      Math.min(after, Math.max(count - 1, 0)),
      reached[quality],
    ];
    const line = quality === 0 ? bestLine : [];
    const numbers = trials.kinds.map((/** @type {string} */ _, /** @type {number} */ k) => k);
    this.history.show(
      { ...common, x: numbers, y: values[quality] ?? [], line, marks: drives.marks(place) },
      new Scale({ label: "trial", lower: -0.02 * count - 0.5, upper: Math.max(1, 1.02 * count - 0.5), integer: true }),
      this.valueScale(quality),
    );
  }
}

/**
 * @param {Iterable<number>} values
 * @returns {[number, number]} the least and the largest
 */
function extent(values) {
  let [least, most] = [Infinity, -Infinity];
  for (const value of values) {
    if (value < least) least = value;
    if (value > most) most = value;
  }
  return least <= most ? [least, most] : [0, 1];
}
