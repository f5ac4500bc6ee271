"use strict";

// The key comes with the address that the terminal shows.
const address = new URLSearchParams(location.search);
const part = (id) => document.getElementById(id);
const view = part("view"), connection = part("connection"), form = part("by-hand");
const sound = part("sound"), links = document.querySelectorAll("a[data-file]");
const asked = part("asked");
const footer = document.querySelector("footer");
const buttons = document.querySelectorAll("button[data-request]");

// The server sends something every second. A connection that is silent for longer is opened anew:
// a phone that was asleep or out of reach does not notice by itself.
const SILENT_MS = 4000, RETRY_MS = 1000;
let priors = {};
let source = null, heardAt = 0, lostAt = null, isOld = false, tones = null;
let lastSentence = "";

const ICONS = {good: "#11703a", busy: "#0b5cad", act: "#c77700", bad: "#b3211c", unknown: "#6b4a8a"};

function show(isLive) {
  if (!isLive && lostAt === null) lostAt = Date.now();
  if (isLive) lostAt = null;
  const at = new Date(lostAt).toLocaleTimeString([], {hour: "2-digit", minute: "2-digit"});
  connection.classList.toggle("lost", !isLive);
  connection.textContent = isLive ? "✓ connected"
    : isOld ? "✗ OLD ADDRESS: open the address that watch shows now"
    : `✗ CONNECTION LOST at ${at}, trying again ...`;
  for (const button of buttons) button.disabled = !isLive;
}

// Who drives does not look at the page: let the phone shake, and sound, when it says something
// else; high for what is good, low for what is bad.
function call(tone) {
  const mayShake = navigator.userActivation?.hasBeenActive !== false;
  if (navigator.vibrate && mayShake) navigator.vibrate([200, 100, 200]);
  if (tones === null) return;
  const beep = tones.createOscillator();
  beep.frequency.value = {good: 1047, bad: 262, act: 392}[tone] || 659;
  beep.connect(tones.destination);
  beep.start();
  beep.stop(tones.currentTime + (tone === "bad" ? 1.2 : 0.3));
}

function put(html) {
  view.innerHTML = html;
  const state = part("state"), shown = state.dataset.buttons.split(" ");
  for (const button of buttons) {
    button.hidden = !shown.includes(button.dataset.request);
    button.classList.toggle("main", shown[0] === button.dataset.request
      && !["solve", "reset"].includes(shown[0]));
  }
  footer.hidden = ["", "reset"].includes(shown[0]);
  part("files").hidden = state.dataset.files === "";
  offer(state.dataset.byHand.split(" ").filter(Boolean), JSON.parse(state.dataset.priors));
  for (const link of links) {
    link.hidden = !state.dataset.files.split(" ").includes(link.dataset.file);
  }
  const headline = view.querySelector(".headline").innerText;
  // A sentence that differs only in its numbers is not new.
  const sentence = headline.replace(/[\d.,]+( (s|min|h)\b)?/g, "");
  if (sentence !== lastSentence) {
    call(state.className);
    part("said").textContent = headline;
  }
  lastSentence = sentence;
  document.title = view.querySelector("h1").textContent;
  const colour = encodeURIComponent(ICONS[state.className]);
  part("icon").href = "data:image/svg+xml,<svg xmlns='http://www.w3.org/2000/svg' "
    + `viewBox='0 0 9 9'><circle cx='4.5' cy='4.5' r='4' fill='${colour}'/></svg>`;
}

// The axes that can be measured by hand, and the priors that are set. What somebody has chosen and
// typed stays.
function offer(axes, set) {
  priors = set;
  form.hidden = axes.length === 0;
  if (asked.dataset.axes !== axes.join(" ")) {
    const chosen = asked.value;
    asked.dataset.axes = axes.join(" ");
    asked.innerHTML = axes.map((axis) => `<option>${axis}</option>`).join("");
    asked.value = axes.includes(chosen) ? chosen : axes[0] || "";
  }
  choose();
}

function choose() {
  part("unit").textContent = "xyz".includes(asked.value) ? "m" : "deg";
  part("forget").hidden = !(asked.value in priors);
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
  source.onerror = () => { source.close(); show(false); look(); };
}

// Another user's server, or one that could not keep its key: no reconnecting finds it.
async function look() {
  try {
    isOld = (await fetch("page.html?" + address, {method: "GET"})).status === 403;
  } catch (error) { isOld = false; }
}

setInterval(() => {
  const isClosed = source.readyState === EventSource.CLOSED;
  if (isClosed || Date.now() - heardAt > SILENT_MS) { show(false); connect(); }
}, RETRY_MS);

async function post(request, more = "") {
  try {
    const answer = await fetch(request + "?" + address + more, {method: "POST"});
    if (!answer.ok) show(false);
  } catch (error) { show(false); }
}

for (const link of links) link.href = link.dataset.file + "?" + address;
for (const button of buttons) {
  button.addEventListener("click", () => {
    if (button.dataset.sure && !confirm(button.dataset.sure)) return;
    const set = Object.entries(priors).map(([axis, prior]) => `${axis} = ${prior}`).join(", ");
    const isReset = button.dataset.request === "reset";
    if (isReset && set && confirm(`Remove the prior, too? It is ${set}.`)) post("forget");
    post(button.dataset.request);
  });
}

form.addEventListener("submit", (event) => {
  event.preventDefault();
  const given = new URLSearchParams(new FormData(form));
  given.set("axis", asked.value);
  post("prior", "&" + given);
});
asked.addEventListener("change", choose);
part("forget").addEventListener("click", () => post("forget", "&axis=" + asked.value));

// Browsers allow sound only after a touch, and a screen that stays on only to pages that come over
// https or from the same computer.
sound.addEventListener("click", () => {
  tones = tones === null ? new AudioContext() : null;
  sound.textContent = tones ? "Sound: on" : "Sound: off";
  sound.setAttribute("aria-pressed", String(tones !== null));
});

function stayOn() {
  if (navigator.wakeLock && document.visibilityState === "visible") {
    navigator.wakeLock.request("screen").catch(() => {});
  }
}
document.addEventListener("visibilitychange", stayOn);
stayOn();
connect();
