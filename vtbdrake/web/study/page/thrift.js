// What a page does by itself rests after each time, so that it takes a small share of a core while the study runs.

const SHARE = 0.003; // of a core, for the model and for new bests
const GROWTH = 1.2; // by how much the trials grow before the server computes again

export class Thrift {
  #next = 0;

  get rests() {
    return performance.now() < this.#next;
  }

  /** @param {number} seconds of a core that it took */
  spent(seconds) {
    this.#next = performance.now() + (1000 * seconds) / SHARE;
  }
}

/** What the server computes from the trials: asked for when something else is wanted, and when there are many more. */
export class Computed {
  /** @type {any} */
  result = null;
  error = ""; // why there is no result
  #key = "";
  #trials = 0;
  #asks = false;
  #thrift = new Thrift();

  /**
   * @param {(command: string, fields: object) => Promise<any>} ask asks the server; the result has the CPU time in
   *   `seconds`
   * @param {() => void} onresult is called when there is another result, or an error instead
   */
  constructor(ask, onresult) {
    this.ask = ask;
    this.onresult = onresult;
  }

  /**
   * @param {string} key
   * @returns {any} the result of that key; null as long as it is not there
   */
  of(key) {
    return key === this.#key ? this.result : null;
  }

  /**
   * Asks, unless the result is there.
   *
   * @param {string} key of what is wanted
   * @param {string} command
   * @param {object} fields
   * @param {{trials: number, running: boolean}} study how many trials it has, and whether it runs
   */
  async want(key, command, fields, { trials, running }) {
    const renews = key === this.#key;
    if (this.#asks || (renews && trials < GROWTH * this.#trials)) return;
    if (renews && running && this.#thrift.rests) return;
    this.#asks = true;
    try {
      const result = await this.ask(command, fields);
      [this.result, this.error] = [result, ""];
      this.#thrift.spent(result.seconds);
    } catch (error) {
      [this.result, this.error] = [null, /** @type {Error} */ (error).message];
    }
    [this.#key, this.#trials, this.#asks] = [key, trials, false];
    this.onresult();
  }
}
