// The table of all trials: sorted by a column, filtered by conditions, some tens at a time.

import { button, element, number, replaceContent } from "./common.js";
import { numberFilter, textFilter } from "./filters.js";
import { Thrift } from "./thrift.js";

const PAGE = 50; // rows at a time
const DIGITS = 4; // of a number
const KINDS = { feasible: "ok", broken: "breaks", dropped: "dropped", failed: "failed" };
const MEANINGS = {
  feasible: "keeps the constraints",
  broken: "breaks a constraint",
  dropped: "dropped by racing: no better than this",
  failed: "a simulation failed",
};
const HINT = "a condition: >1, <=2, 1..2, or a value";

/**
 * A column: `of` gives its value for a trial, `shown` the text of a value; `test` is its filter.
 *
 * @typedef {{
 *   label: string,
 *   title: string,
 *   of: (trial: number) => any,
 *   shown: (value: any) => string,
 *   isText: boolean,
 *   descending: boolean,
 *   test: ((value: any) => boolean) | null,
 *   head?: any,
 * }} Column
 */

export class TrialTable {
  #sorted = 0; // the column by which the rows are sorted
  #isDescending = false;
  #kind = ""; // of the trials in the table; "front" for the Pareto front, empty for all
  #first = 0; // place of the first row of this page
  #thrift = new Thrift();

  /**
   * @param {any} page whose trials it shows
   */
  constructor(page) {
    this.page = page;
    this.columns = this.#columns();
    [this.#sorted, this.#isDescending] = [2, this.columns[2].descending];
    this.body = element("tbody");
    this.table = element(
      "table",
      { id: "vtb-trials" },
      element("thead", {}, this.#heads(), this.#filters()),
      this.body,
    );
    this.count = element("output");
    this.earlier = element("button", { id: "vtb-earlier", onclick: () => this.#turn(-PAGE) }, "‹ previous");
    this.later = element("button", { id: "vtb-later", onclick: () => this.#turn(PAGE) }, "next ›");
    const scroll = element("div", { className: "vtb-scroll", tabIndex: 0, role: "region" }, this.table);
    scroll.setAttribute("aria-label", "table of the trials");
    const save = button("vtb-csv", "CSV", "save these trials as a table, with all digits", () => this.#save());
    const pager = element("div", { className: "vtb-row vtb-pager" }, this.earlier, this.later, save, this.count);
    this.section = element("section", { id: "vtb-all" }, pager, scroll);
  }

  /** @returns {Column[]} */
  #columns() {
    const { page } = this;
    const { trials, parameters, qualities } = page;
    const shown = (/** @type {any} */ value) => number(value, DIGITS);
    const plain = { isText: false, descending: false, test: null };
    /** @type {Column[]} */
    const columns = [
      { ...plain, label: "trial", title: "number of the trial", of: (k) => k, shown: String },
      {
        ...plain,
        label: "end",
        title: "how the trial came out",
        of: (k) => trials.kinds[k],
        shown: (kind) => KINDS[/** @type {keyof KINDS} */ (kind)],
        isText: true,
      },
    ];
    qualities.forEach((/** @type {any} */ { minimize }, /** @type {number} */ q) =>
      columns.push({
        ...plain,
        label: page.qualityArrow(q),
        title: `${page.qualityLabel(q)}, ${minimize ? "minimized" : "maximized"}`,
        of: (k) => trials.values[q][k],
        shown,
        descending: !minimize,
      }),
    );
    parameters.forEach((/** @type {any} */ { options, unit }, /** @type {number} */ p) =>
      columns.push({
        ...plain,
        label: page.parameterLabel(p),
        title: unit && unit !== "1" ? `${parameters[p].address} [${unit}]` : parameters[p].address,
        of: (k) => (options ? options[trials.points[p][k]] : trials.points[p][k]),
        shown: options ? String : shown,
        isText: Boolean(options),
      }),
    );
    return columns;
  }

  // -- elements

  #heads() {
    const cells = this.columns.map((column, c) => {
      // Where a long name may be broken.
      const words = column.label.split(/(?<=[. ])/).flatMap((word) => [word, element("wbr")]);
      const head = element("button", { title: `${column.title}: sort`, onclick: () => this.#sort(c) }, ...words);
      column.head = element("th", { scope: "col" }, head);
      return column.head;
    });
    return element("tr", {}, ...cells);
  }

  #filters() {
    const cells = this.columns.map((column, c) => element("td", {}, c === 1 ? this.#kinds() : this.#filter(column)));
    return element("tr", { className: "vtb-filters" }, ...cells);
  }

  /** @param {Column} column */
  #filter(column) {
    const field = element("input", {
      type: "text",
      placeholder: "filter",
      title: column.isText ? "a part of the text" : HINT,
      ariaLabel: `filter of ${column.title}`,
      oninput: () => {
        const text = field.value;
        column.test = !text.trim() ? null : column.isText ? textFilter(text) : numberFilter(text, column.shown);
        field.setAttribute("aria-invalid", String(Boolean(text.trim()) && !column.test));
        this.#renew();
      },
    });
    return field;
  }

  #kinds() {
    const options = [
      ["", "all"],
      ...Object.entries(KINDS),
      ...(this.page.qualities.length > 1 ? [["front", "front"]] : []),
    ].map(([value, text]) => element("option", { value }, text));
    const select = element("select", {
      ariaLabel: "filter of how the trial came out",
      onchange: () => {
        this.#kind = select.value;
        this.#renew();
      },
    });
    select.append(...options);
    return select;
  }

  // -- rows

  /** @returns {string} the trials that the filters let through, as comma-separated values */
  csv() {
    const quoted = (/** @type {any} */ value) => {
      const text = String(value ?? "");
      return /[",\n]/.test(text) ? `"${text.replaceAll('"', '""')}"` : text;
    };
    const rows = [
      this.columns.map(({ label, title }, c) => (c < 2 ? label : title)),
      ...this.chosen().map((k) => this.columns.map(({ of }) => of(k))),
    ];
    return rows.map((row) => `${row.map(quoted).join(",")}\n`).join("");
  }

  #save() {
    const href = URL.createObjectURL(new Blob([this.csv()], { type: "text/csv" }));
    element("a", { href, download: `${this.page.hello.name}.csv` }).click();
    URL.revokeObjectURL(href);
  }

  /** @param {number} c the column */
  #sort(c) {
    this.#isDescending = this.#sorted === c ? !this.#isDescending : this.columns[c].descending;
    this.#sorted = c;
    this.#renew();
  }

  /** @param {number} rows */
  #turn(rows) {
    this.#first += rows;
    this.show();
  }

  #renew() {
    this.#first = 0;
    this.show();
  }

  /** @returns {number[]} the trials that the filters let through, in the order of the table */
  chosen() {
    const { trials } = this.page;
    const front = new Set(trials.front);
    const tests = this.columns.filter(({ test }) => test);
    /** @type {number[]} */
    const chosen = [];
    for (let k = 0; k < trials.count; k++) {
      const isOfKind = !this.#kind || (this.#kind === "front" ? front.has(k) : trials.kinds[k] === this.#kind);
      if (isOfKind && tests.every(({ of, test }) => test?.(of(k)))) chosen.push(k);
    }
    const { of } = this.columns[this.#sorted];
    const sign = this.#isDescending ? -1 : 1;
    return chosen.sort((a, b) => {
      const [x, y] = [of(a), of(b)];
      if (x === null || y === null) return Number(x === null) - Number(y === null) || a - b;
      return (x < y ? -sign : x > y ? sign : 0) || a - b;
    });
  }

  /** Shows the trials again, if the table is open; while the study runs by itself, it rests between. */
  renewed() {
    if (!this.section.hidden && !(this.page.isRunning && this.#thrift.rests)) this.show();
  }

  show() {
    const begin = performance.now();
    const chosen = this.chosen();
    this.#first = Math.min(Math.max(this.#first, 0), Math.max(0, Math.ceil(chosen.length / PAGE) - 1) * PAGE);
    const rows = chosen.slice(this.#first, this.#first + PAGE);
    this.columns.forEach(({ head }, c) => {
      const order = this.#isDescending ? "descending" : "ascending";
      head.setAttribute("aria-sort", c === this.#sorted ? order : "none");
    });
    // The focus stays on the trial where it was.
    const focused = this.body.contains(document.activeElement) ? document.activeElement?.textContent : null;
    replaceContent(this.body, ...rows.map((k) => this.#row(k)));
    if (focused) this.body.querySelector(`[data-trial="${focused}"] button`)?.focus();
    const { count } = this.page.trials;
    const places = rows.length ? `${this.#first + 1} to ${this.#first + rows.length} of ` : "";
    const total = chosen.length === count ? `${count}` : `${chosen.length} (${count} in all)`;
    this.count.textContent = `${places}${total} ${count === 1 ? "trial" : "trials"}`;
    this.page.allow(this.earlier, this.#first > 0 ? "" : "these are the first trials");
    this.page.allow(this.later, this.#first + PAGE < chosen.length ? "" : "these are the last trials");
    this.#thrift.spent((performance.now() - begin) / 1000);
  }

  /** @param {number} k the trial */
  #row(k) {
    const { rollouts, trials } = this.page;
    const keep = () => rollouts.pin(k);
    const cells = this.columns.slice(2).map(({ of, shown }) => element("td", {}, shown(of(k))));
    const origin = `${trials.methods[k]}, batch ${trials.batches[k]}${trials.byHand.has(k) ? ", by hand" : ""}`;
    const kind = /** @type {keyof KINDS} */ (trials.kinds[k]);
    const meaning = kind === "failed" ? (trials.reasons[k] ?? MEANINGS.failed) : MEANINGS[kind];
    return element(
      "tr",
      {
        "data-trial": k,
        className: k === rollouts.shown ? "chosen" : "",
        onclick: keep,
        onmouseenter: () => rollouts.point({ trial: k }),
        onmouseleave: () => rollouts.point(null),
      },
      element(
        "th",
        { scope: "row" },
        element("button", { title: `show it (${origin})`, onfocus: () => rollouts.point({ trial: k }) }, k),
      ),
      element("td", { title: meaning, className: kind }, KINDS[kind]),
      ...cells,
    );
  }
}
