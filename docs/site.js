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
/* The theme searches for every word as a prefix, so "a" and "to" find "arm" and "tools". Remove
   such words from a query. A query of such words alone, or a quoted query, remains as it is. */
const STOP_WORDS = new Set(
  ("a an and are as at be by can do does for from get has have how i if in into is it its know " +
   "my not of on or so than that the their this to was what when where which why will with")
    .split(" "));
const QUERY = 2; // Type of the theme's messages that contain a query.
function withoutStopWords(query) {
  if (query.includes('"')) return query;
  const words = query.split(/\s+/).filter((word) => !STOP_WORDS.has(word.toLowerCase()));
  return words.some((word) => word) ? words.join(" ") : query;
}
const postMessage = Worker.prototype.postMessage;
Worker.prototype.postMessage = function (message, ...rest) {
  const isQuery = message && message.type === QUERY && typeof message.data === "string";
  const sent = isQuery ? {...message, data: withoutStopWords(message.data)} : message;
  return postMessage.call(this, sent, ...rest);
};
