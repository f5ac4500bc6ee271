"use strict";

// The key comes with the address that the terminal shows.
const address = new URLSearchParams(location.search);
const view = document.getElementById("view");
const connection = document.getElementById("connection");
const footer = document.querySelector("footer");
const buttons = document.querySelectorAll("button");

// The server sends something every second. A connection that is silent for longer is opened anew:
// a phone that was asleep or out of reach does not notice by itself.
const SILENT_MS = 4000, RETRY_MS = 1000;
let source = null, heardAt = 0, lostAt = null;

function show(isLive) {
  if (!isLive && lostAt === null) lostAt = Date.now();
  if (isLive) lostAt = null;
  const seconds = lostAt === null ? 0 : Math.round((Date.now() - lostAt) / 1000);
  connection.classList.toggle("lost", !isLive);
  connection.textContent = isLive
    ? "✓ connected" : `✗ NO CONNECTION for ${seconds} s, trying again ...`;
  for (const button of buttons) button.disabled = !isLive;
}

function put(html) {
  view.innerHTML = html;
  // A node that only watches the mount has no bars, and nothing to solve, save or reset.
  footer.hidden = view.querySelector("progress") === null;
  const word = view.querySelector("h1").textContent;
  // Who drives does not look at the page: let the phone shake when it says something else.
  if (word !== document.title && navigator.vibrate) navigator.vibrate([200, 100, 200]);
  document.title = word;
}

function connect() {
  if (source !== null) source.close();
  heardAt = Date.now();
  source = new EventSource("events?" + address);
  source.onmessage = (event) => {
    heardAt = Date.now();
    show(true);
    if (event.data) put(event.data);
  };
  source.onerror = () => { source.close(); show(false); };
}

setInterval(() => {
  const isClosed = source.readyState === EventSource.CLOSED;
  if (isClosed || Date.now() - heardAt > SILENT_MS) { show(false); connect(); }
}, RETRY_MS);

for (const button of buttons) {
  button.addEventListener("click", () => {
    if (button.dataset.sure && !confirm(button.dataset.sure)) return;
    fetch(button.dataset.request + "?" + address, {method: "POST"})
      .then((answer) => { if (!answer.ok) show(false); }, () => show(false));
  });
}

connect();
