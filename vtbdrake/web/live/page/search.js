// Finds addresses of variables: a list below a field, which arrow keys walk.

import { element } from "./common.js";

const MATCHES = 60; // addresses that are listed

/**
 * @param {string} unit
 * @returns {string} the unit as it is shown: nothing for numbers without one
 */
export const shownUnit = (unit) => (unit === "1" ? "" : unit);

export class Search {
  /** @type {Record<string, { unit: string }>} */
  variables = {};
  active = -1; // number of the match that Enter chooses

  /** @param {(address: string) => void} choose is called with an address that was chosen */
  constructor(choose) {
    this.choose = choose;
    this.input = element("input", {
      type: "search",
      id: "vtb-search",
      placeholder: "find a variable (/)",
      role: "combobox",
      autocomplete: "off",
      "aria-label": "find a variable",
      "aria-controls": "vtb-matches",
      "aria-expanded": "false",
      "aria-autocomplete": "list",
      oninput: () => this.#find(),
      onkeydown: (/** @type {KeyboardEvent} */ event) => this.#key(event),
    });
    this.matches = element("ul", { id: "vtb-matches", role: "listbox", "aria-label": "variables" });
    this.more = element("small", { id: "vtb-more", role: "status" });
    this.root = element("div", {}, this.input, this.matches, this.more);
  }

  /** @param {Record<string, { unit: string }>} variables among which it finds; somebody may be typing already */
  hello(variables) {
    this.variables = variables;
    if (this.input.value) this.#find();
  }

  /** @param {boolean} all whether to list all addresses for an empty field */
  #find(all = false) {
    const words = this.input.value.toLowerCase().split(/\s+/).filter(Boolean);
    const addresses =
      words.length || all
        ? Object.keys(this.variables).filter((a) =>
            words.every((/** @type {string} */ w) => a.toLowerCase().includes(w)),
          )
        : [];
    this.matches.replaceChildren(...addresses.slice(0, MATCHES).map((address, index) => this.#option(address, index)));
    const left = addresses.length - MATCHES;
    if (left > 0) this.more.textContent = `and ${left} more: type another word`;
    else this.more.textContent = words.length && !addresses.length ? "no variable has all of these words" : "";
    this.input.setAttribute("aria-expanded", String(addresses.length > 0));
    this.#walk(words.length && addresses.length ? 0 : -1);
  }

  /**
   * @param {string} address
   * @param {number} index
   * @returns {HTMLLIElement}
   */
  #option(address, index) {
    const unit = element("span", {}, shownUnit(this.variables[address].unit));
    const properties = { id: `vtb-match-${index}`, role: "option", "aria-selected": "false" };
    return element("li", { ...properties, onclick: () => this.choose(address) }, address, unit);
  }

  /** @param {number} index of the match to go to; -1 for none */
  #walk(index) {
    const { children } = this.matches;
    this.active = index;
    for (const [number, option] of [...children].entries())
      option.setAttribute("aria-selected", String(number === index));
    if (index >= 0) {
      children[index].scrollIntoView({ block: "nearest" });
      this.input.setAttribute("aria-activedescendant", children[index].id);
    } else this.input.removeAttribute("aria-activedescendant");
  }

  /** @param {KeyboardEvent} event */
  #key(event) {
    const { length } = this.matches.children;
    if (event.key === "ArrowDown" && !length) this.#find(true);
    if (event.key === "ArrowDown") this.#walk(Math.min(this.active + 1, this.matches.children.length - 1));
    else if (event.key === "ArrowUp") this.#walk(Math.max(this.active - 1, 0));
    else if (event.key === "Enter") this.matches.children[this.active]?.click();
    else if (event.key === "Escape" && this.input.value + length) this.#clear();
    else return;
    event.preventDefault();
    event.stopPropagation();
  }

  #clear() {
    this.input.value = "";
    this.#find();
  }
}
