// The legend of the ghosts that are in the scene: what each colour stands for.

import { element } from "./common.js";

const TITLES = {
  preview: "preview of the draft",
  refused: "preview that fails",
  without: "course without the change",
  branch: "other branch",
  recorded: "recorded course",
  perceived: "perceived by the DPS",
};

/**
 * @param {{ recorded?: boolean, branch?: boolean }} comparison
 * @returns {"recorded" | "branch" | "without"} the name of the course beside the present one
 */
export function otherCourse({ recorded, branch }) {
  if (recorded) return "recorded";
  return branch ? "branch" : "without";
}

export class GhostLegend {
  /** @type {Record<string, string>} */
  tints = {};
  shown = "";

  constructor() {
    this.root = element("ul", { id: "vtb-ghosts", "aria-label": "ghosts in the scene" });
    document.body.append(this.root);
  }

  /** @param {Record<string, string>} tints the colour of each ghost by name */
  hello(tints) {
    this.tints = tints;
  }

  /**
   * @param {{ preview: any, comparison: any }} frame
   * @param {boolean} perceived whether what is perceived is shown
   */
  frame({ preview, comparison }, perceived) {
    /** @type {(keyof typeof TITLES)[]} */
    const names = [];
    if (preview) names.push(preview.refused ? "refused" : "preview");
    if (comparison) names.push(otherCourse(comparison));
    if (perceived) names.push("perceived");
    if (names.join() === this.shown) return;
    this.shown = names.join();
    this.root.replaceChildren(...names.map((name) => this.#row(name)));
  }

  /** @param {keyof typeof TITLES} name */
  #row(name) {
    const mark = element("i");
    mark.style.background = this.tints[name] ?? "";
    return element("li", {}, mark, TITLES[name]);
  }
}
