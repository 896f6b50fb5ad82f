// How much each parameter decides whether a trial is among the best, as bars.

import { element } from "./common.js";

export class Importance {
  constructor() {
    this.element = element("table", { id: "vtb-importance" });
  }

  /**
   * @param {string} quality its name
   * @param {{shares: Record<string, number>, points: number} | null} result the shares by address, and how many trials
   *   they are of; null before the first is there
   * @param {(address: string) => string} label of a parameter
   */
  show(quality, result, label) {
    if (!result) return this.element.replaceChildren(element("caption", {}, "computing the importances…"));
    const { shares, points } = result;
    const most = Math.max(...Object.values(shares));
    const rows = Object.entries(shares).map(([address, share]) =>
      element(
        "tr",
        {},
        element("th", { scope: "row", title: address }, label(address)),
        element("td", {}, element("i", { style: `width: ${(100 * share) / most}%` })),
        element("td", {}, `${(100 * share).toFixed(1)} %`),
      ),
    );
    const caption = `What decides whether a trial is among the best tenth of ${quality} (of ${points} with a value)`;
    const method = "PED-ANOVA: how far the best tenth is distributed in another way than all, along each parameter";
    return this.element.replaceChildren(element("caption", { title: method }, caption), ...rows);
  }
}
