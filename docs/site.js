/* Names and keyboard focus that the theme leaves out. The theme adds some elements later. */
"use strict";
const missing = [
  [".md-search[role=dialog]", "aria-label", "Search"],
  [".md-code__nav, .md-nav--secondary .md-nav", "role", "presentation"],
  [".md-typeset pre > code, .md-typeset__scrollwrap", "tabindex", "0"],
];
function complete() {
  for (const [selector, name, value] of missing) {
    for (const element of document.querySelectorAll(selector)) {
      if (element.getAttribute(name) !== value) element.setAttribute(name, value);
      // An element without a role has no name.
      if (value === "presentation") element.removeAttribute("aria-label");
    }
  }
}
document.addEventListener("DOMContentLoaded", () => {
  complete();
  new MutationObserver(complete).observe(document.body, {childList: true, subtree: true});
});
