// What the pages use without importing it: Meshcat's viewer and uPlot, which other scripts of a page make, and Colab.

declare const viewer: any;
declare const uPlot: any;
declare var vtb: any;

interface Window {
  readonly google?: any;
}
