// Shows a page of the kernel's machine in a cell of a notebook, instead of its picture, where it can be reached.
// It is part of the cell's output, in a function of its own: VS Code loads no modules there.

/**
 * The address of the page, as a browser reaches it from the front end in which the notebook is open.
 *
 * @param {{ port: number, path: string, prefix: string }} settings
 * @param {{ location: Location, document: Document, google?: any }} window
 */
async function addressOf({ port, path, prefix }, { location, document, google }) {
  const loopback = ["localhost", "127.0.0.1", "[::1]"].includes(location.hostname);
  if (google?.colab) return new URL(path, await google.colab.kernel.proxyPort(port, { cache: true })).href;
  if (location.protocol === "vscode-webview:") return `http://localhost:${port}/${path}`; // VS Code forwards the port
  // Of the notebook's site, whatever its name.
  if (loopback && !prefix) return `http://${location.hostname}:${port}/${path}`;
  const config = document.getElementById("jupyter-config-data")?.textContent; // of JupyterLab and Notebook 7
  const base = prefix || (config && JSON.parse(config).baseUrl) || document.body.dataset.baseUrl || "/";
  return new URL(`${base}proxy/${port}/${path}`, location.href).href; // of jupyter-server-proxy
}

/**
 * The origins of the pages around the frame, which alone may show it; none where they are not known, or not of the web.
 *
 * @param {{ location: Location, self: any, top: any }} window
 */
function framedIn({ location, self, top }) {
  const outer = location.ancestorOrigins ?? (self === top ? [] : ["unknown"]);
  const origins = [location.origin, ...outer];
  if (!origins.every((origin) => /^https?:/.test(origin))) return "";
  return `?${new URLSearchParams(origins.map((origin) => ["in", origin]))}`;
}

/**
 * Replaces the picture by the page, unless the server has ended or the proxy is missing.
 *
 * @param {HTMLElement} place
 * @param {{ port: number, path: string, prefix: string, height: number }} settings
 */
// eslint-disable-next-line no-unused-vars -- The cell calls it.
async function show(place, settings) {
  const address = await addressOf(settings, window);
  if (location.protocol !== "vscode-webview:" && !window.google?.colab) {
    const answer = await fetch(address, { mode: "no-cors", cache: "no-store", referrerPolicy: "no-referrer" }).catch(
      () => null,
    );
    if (!answer || !(answer.ok || answer.type === "opaque")) {
      place.dataset.state = "unreachable";
      return;
    }
  }
  const frame = document.createElement("iframe");
  frame.src = address + framedIn(window);
  frame.referrerPolicy = "no-referrer";
  frame.allow = "gamepad; fullscreen; xr-spatial-tracking";
  frame.style.cssText = `width: 100%; height: ${settings.height}px; border: 0`;
  place.replaceChildren(frame);
  place.dataset.state = "open";
}
