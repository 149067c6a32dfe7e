// Rules for the JavaScript of the pages; types are checked by tsc (tsconfig.json).

import js from "@eslint/js";
import globals from "globals";

export default [
  js.configs.recommended,
  {
    files: ["foveasim/studio/static/**/*.js", "foveasim/view/web/*.js"],
    languageOptions: { ecmaVersion: 2024, sourceType: "module", globals: globals.browser },
    linterOptions: { reportUnusedDisableDirectives: "error" },
    rules: {
      eqeqeq: "error",
      "max-len": ["error", { code: 140 }],
      "no-shadow-restricted-names": "error",
      "no-unused-vars": ["error", { args: "after-used", argsIgnorePattern: "^_|^root$" }],
      "no-var": "error",
      "object-shorthand": "error",
      "prefer-const": ["error", { destructuring: "all" }],
      // Lines of the bundle's imports, too: foveasim/view/web/_page.py.
      "no-restricted-syntax": ["error", { selector: "ImportDefaultSpecifier, ImportNamespaceSpecifier", message: "import names" }],
    },
  },
  {
    files: ["**/*.js"],
    rules: { "no-warning-comments": "error" },
  },
];
