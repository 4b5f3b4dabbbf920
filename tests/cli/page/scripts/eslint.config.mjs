// What eslint finds in the page beside the types: names that are not there, not used, not changed.

const words = "addEventListener clearTimeout confirm CustomEvent devicePixelRatio document DataView Error EventTarget fetch File getComputedStyle HTMLElement Infinity innerWidth location matchMedia Math navigator performance postMessage prompt requestAnimationFrame ResizeObserver Response setTimeout TextDecoder URL URLSearchParams Worker";

export default [{
  languageOptions: { ecmaVersion: 2024, sourceType: "module", globals: Object.fromEntries(words.split(" ").map((one) => [one, "readonly"])) },
  rules: {
    eqeqeq: "error", "no-undef": "error", "no-unused-vars": "error", "no-var": "error", "prefer-const": "error", "no-shadow": "off",
    "no-unreachable": "error", "no-dupe-keys": "error", "no-eval": "error", "no-implied-eval": "error", "no-self-assign": "error",
  },
}];
