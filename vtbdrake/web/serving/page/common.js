// Elements and connection of the pages.

/**
 * @param {string} tag
 * @param {Record<string, any>} properties properties, attributes, and by on... listeners
 * @param {any[]} children
 * @returns {any} an element of that tag, whose type depends on it
 */
export function element(tag, properties = {}, ...children) {
  /** @type {any} */
  const made = document.createElement(tag);
  for (const [name, value] of Object.entries(properties)) {
    if (name.startsWith("on")) made.addEventListener(name.slice(2), value);
    else if (name in made) made[name] = value;
    else made.setAttribute(name, value);
  }
  made.append(...children);
  return made;
}

/**
 * @param {"script" | "link"} tag
 * @param {Record<string, any>} properties
 * @returns {Promise<Event>} fulfilled when it is loaded
 */
export function load(tag, properties) {
  return new Promise((resolve, reject) => {
    document.head.append(element(tag, { ...properties, onload: resolve, onerror: reject }));
  });
}

/**
 * @param {number | string | null | undefined} value
 * @param {number} [digits]
 * @returns {string} its text; "none" for none
 */
export const number = (value, digits = 5) =>
  value === null || value === undefined ? "none" : String(Number(Number(value).toPrecision(digits)));

/**
 * @param {number} count
 * @param {string} noun in the singular
 * @returns {string} such as "1 point", "2 points"
 */
export const counted = (count, noun) => `${count} ${noun}${count === 1 ? "" : "s"}`;

/**
 * @param {string} id empty for none
 * @param {string} label
 * @param {string} title
 * @param {(event: MouseEvent) => unknown} onclick
 * @returns {HTMLButtonElement}
 */
export const button = (id, label, title, onclick) => element("button", { ...(id && { id }), title, onclick }, label);

// -- messages

// What a page tells a person.
export class Telling {
  /** @type {HTMLElement} */
  messages = element("div", { id: "vtb-messages", role: "status" });

  constructor() {
    document.documentElement.lang = "en"; // Meshcat's page does not say so.
    document.body.append(this.messages);
    document.addEventListener("click", (event) => this.#refuse(event), true);
  }

  /**
   * Lets a button do its work, or grey it with the reason why it cannot; it stays within reach, and tells the reason.
   *
   * @param {HTMLElement} control
   * @param {string} reason empty if it can
   */
  allow(control, reason) {
    control.dataset.does ??= control.title;
    control.title = reason || control.dataset.does;
    control.setAttribute("aria-disabled", String(Boolean(reason)));
  }

  /** @param {MouseEvent} event */
  #refuse(event) {
    const control = event.target instanceof Element ? event.target.closest("[aria-disabled=true]") : null;
    if (!(control instanceof HTMLElement)) return;
    event.preventDefault();
    event.stopPropagation();
    this.say(control.title);
  }

  /**
   * @param {string} kind
   * @returns {HTMLElement | null} the message of a kind
   */
  told(kind) {
    return this.messages.querySelector(`[data-kind="${kind}"]`);
  }

  /**
   * Shows a message for a while; one of a kind replaces the older one and stays until it is taken back. It returns
   * nothing: what asks for something and tells its failure must not take the message for the result.
   *
   * @param {string} text
   */
  say(text, className = "", kind = "") {
    const older = kind ? this.told(kind) : null;
    /** @type {HTMLElement} */
    const shown = older ?? element("p");
    if (!older) this.messages.prepend(shown);
    shown.className = className;
    if (shown.textContent !== text) shown.textContent = text;
    if (kind) shown.dataset.kind = kind;
    else setTimeout(() => shown.remove(), 8000);
  }

  /**
   * @template T
   * @param {Promise<T>} asked
   * @returns {Promise<T | undefined>} its result (null, if it has none); undefined if it was refused, which is told
   */
  async orTell(asked, kind = "") {
    try {
      return await asked;
    } catch (error) {
      this.say(error instanceof Error ? error.message : String(error), "bad", kind);
      return undefined;
    }
  }

  /** @param {string} kind */
  takeBack(kind) {
    this.told(kind)?.remove();
  }
}

// -- the connection

const RETRY = 1000; // ms between two looks for a server that is lost

/**
 * Looks for the server until it answers, and loads the page anew then: its picture, too, has to begin from nothing.
 *
 * @param {() => void} refused is called where it answers, and knows this page's session no more
 */
export async function reloadWhenBack(refused) {
  for (;;) {
    await new Promise((resolve) => setTimeout(resolve, RETRY));
    const answer = await fetch(location.href, { cache: "no-store" }).catch(() => null);
    if (answer?.ok) return location.reload();
    if (answer) refused();
  }
}

export class Connection {
  #socket;
  #number = 0;
  /** @type {Map<number, { resolve: (result: any) => void, reject: (error: Error) => void }>} */
  #waiting = new Map();

  /** @param {{ closed: () => void, [type: string]: (message: any) => unknown }} handlers by the type of a message */
  constructor(handlers) {
    this.#socket = new WebSocket(new URL("session", location.href).href.replace(/^http/, "ws"));
    this.#socket.onmessage = ({ data }) => {
      const message = JSON.parse(data);
      if (message.type !== "answer") return handlers[message.type](message);
      const { resolve, reject } = this.#waiting.get(message.id) ?? {};
      this.#waiting.delete(message.id);
      if (message.error) reject?.(new Error(message.error));
      else resolve?.(message.result);
    };
    this.#socket.onclose = () => {
      for (const { reject } of this.#waiting.values()) reject(new Error("the session has ended"));
      this.#waiting.clear();
      handlers.closed();
    };
  }

  /**
   * Sends a command.
   *
   * @param {string} command
   * @param {Record<string, any>} fields
   * @returns {Promise<any>} fulfilled with its result when it has been carried out
   */
  ask(command, fields = {}) {
    const id = ++this.#number;
    if (this.#socket.readyState !== WebSocket.OPEN)
      return Promise.reject(new Error("the page has no connection to its server"));
    return new Promise((resolve, reject) => {
      this.#waiting.set(id, { resolve, reject });
      this.#socket.send(JSON.stringify({ id, do: command, ...fields }));
    });
  }
}
