// Rules of the scripts of the pages. What a browser and Meshcat's page have is global.

import js from "@eslint/js";
import globals from "globals";

const meshcat = { viewer: "readonly", uPlot: "readonly", vtb: "writable", XRRigidTransform: "readonly" };

export default [
  js.configs.recommended,
  {
    languageOptions: { ecmaVersion: 2023, sourceType: "module", globals: { ...globals.browser, ...meshcat } },
    linterOptions: { reportUnusedDisableDirectives: "error" },
    rules: {
      complexity: ["error", 15],
      "consistent-this": "error",
      eqeqeq: "error",
      "max-depth": ["error", 4],
      "max-len": ["error", { code: 120 }],
      "no-shadow": ["error", { hoist: "functions" }],
      "no-unused-vars": ["error", { argsIgnorePattern: "^_" }],
      "no-var": "error",
      "prefer-const": ["error", { destructuring: "all" }],
    },
  },
];
