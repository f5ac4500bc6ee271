"use strict";

// The address of the page contains the key, which every request needs.
const address = new URLSearchParams(location.search);
const element = (id) => document.getElementById(id);
const view = element("view"), connection = element("connection"), form = element("by-hand");
const sound = element("sound"), links = document.querySelectorAll("a[data-file]");
const axisByHand = element("by-hand-axis");
const footer = document.querySelector("footer");
const buttons = document.querySelectorAll("button[data-request]");

// The server sends an event every second. After a longer silence (ms) the page connects again: a
// phone that was asleep or out of reach does not notice that its connection is lost.
const MAX_SILENCE_MS = 4000;
// Period (ms) at which the page checks its connection.
const CHECK_PERIOD_MS = 1000;
// Priors that are set, by axis.
let priors = {};
// Connection to the server, and the times of its last event and of its loss.
let source = null, receivedAt = 0, lostAt = null;
// Whether the server has another key, so that the address of this page is useless.
let isOldAddress = false;
// Output of sounds; null while sounds are off.
let audio = null;
let lastSentence = "";

// Colour of the page's icon, by tone.
const ICONS = {good: "#11703a", busy: "#0b5cad", act: "#c77700", bad: "#b3211c", unknown: "#6b4a8a"};

function showConnection(isLive) {
  if (!isLive && lostAt === null) lostAt = Date.now();
  if (isLive) lostAt = null;
  const at = new Date(lostAt).toLocaleTimeString([], {hour: "2-digit", minute: "2-digit"});
  let text = `✗ CONNECTION LOST at ${at}, trying again ...`;
  if (isOldAddress) text = "✗ OLD ADDRESS: open the address that watch shows now";
  if (isLive) text = "✓ connected";
  connection.classList.toggle("lost", !isLive);
  connection.textContent = text;
  for (const button of buttons) button.disabled = !isLive;
}

// A driver does not look at the page. So the phone vibrates and beeps at each new headline: with a
// high tone if it is good, with a low tone if it is bad.
function alertPerson(tone) {
  // Browsers refuse vibration before the first touch.
  const mayVibrate = navigator.userActivation?.hasBeenActive !== false;
  if (navigator.vibrate && mayVibrate) navigator.vibrate([200, 100, 200]);
  if (audio === null) return;
  const beep = audio.createOscillator();
  beep.frequency.value = {good: 1047, bad: 262, act: 392}[tone] || 659;
  beep.connect(audio.destination);
  beep.start();
  beep.stop(audio.currentTime + (tone === "bad" ? 1.2 : 0.3));
}

// Display the HTML of a view, and the buttons and links that its first element lists.
function display(html) {
  view.innerHTML = html;
  const state = element("state"), requests = state.dataset.buttons.split(" ");
  for (const button of buttons) {
    const request = button.dataset.request;
    const isInFooter = footer.contains(button), isAsked = request === state.dataset.asked;
    button.hidden = !requests.includes(request);
    // Reset is always within reach if the headline asks for it, otherwise apart at the end.
    if (request === "reset" && isInFooter !== isAsked) button.hidden = true;
    button.classList.toggle("main", isInFooter && isAsked);
  }
  footer.hidden = [...footer.children].every((button) => button.hidden);
  element("files").hidden = state.dataset.files === "";
  element("pose-of").textContent = state.dataset.poseOf;
  offerAxes(state.dataset.byHand.split(" ").filter(Boolean), JSON.parse(state.dataset.priors));
  for (const link of links) {
    link.hidden = !state.dataset.files.split(" ").includes(link.dataset.file);
  }
  const headline = view.querySelector(".headline").innerText;
  // A headline that differs only in its numbers is not new.
  const sentence = headline.replace(/[\d.,]+( (s|min|h)\b)?/g, "");
  if (sentence !== lastSentence) {
    alertPerson(state.className);
    element("announcement").textContent = headline;
  }
  lastSentence = sentence;
  document.title = view.querySelector("h1").textContent;
  const colour = encodeURIComponent(ICONS[state.className]);
  element("icon").href = "data:image/svg+xml,<svg xmlns='http://www.w3.org/2000/svg' "
    + `viewBox='0 0 9 9'><circle cx='4.5' cy='4.5' r='4' fill='${colour}'/></svg>`;
}

// Fill the form for values measured by hand. The axis that a person has chosen and the values that
// a person has typed stay.
function offerAxes(axes, newPriors) {
  priors = newPriors;
  form.hidden = axes.length === 0;
  if (axisByHand.dataset.axes !== axes.join(" ")) {
    const chosen = axisByHand.value;
    axisByHand.dataset.axes = axes.join(" ");
    axisByHand.innerHTML = axes.map((axis) => `<option>${axis}</option>`).join("");
    axisByHand.value = axes.includes(chosen) ? chosen : axes[0] || "";
  }
  updateForm();
}

// Display the unit of the chosen axis, and the button that removes its prior.
function updateForm() {
  element("unit").textContent = "xyz".includes(axisByHand.value) ? "m" : "deg";
  element("forget").hidden = !(axisByHand.value in priors);
  const [value, sigma] = (priors[axisByHand.value] || "").split("+/-");
  form.elements.value.placeholder = value;
  form.elements.sigma.placeholder = sigma || "";
}

function connect() {
  if (source !== null) source.close();
  receivedAt = Date.now();
  source = new EventSource("events?" + address);
  source.onmessage = (event) => {
    receivedAt = Date.now();
    showConnection(true);
    if (event.data) display(event.data);
  };
  source.onerror = () => { source.close(); showConnection(false); checkAddress(); };
}

// The server refuses the key if it is the server of another user, or if it could not store its key
// at the last start. Then a new connection fails, too.
async function checkAddress() {
  try {
    isOldAddress = (await fetch("page.html?" + address, {method: "GET"})).status === 403;
  } catch (error) { isOldAddress = false; }
}

setInterval(() => {
  const isClosed = source.readyState === EventSource.CLOSED;
  if (isClosed || Date.now() - receivedAt > MAX_SILENCE_MS) { showConnection(false); connect(); }
}, CHECK_PERIOD_MS);

// Send a request to the server; ``more`` are further arguments, such as "&axis=z".
async function post(request, more = "") {
  try {
    const answer = await fetch(request + "?" + address + more, {method: "POST"});
    if (!answer.ok) showConnection(false);
  } catch (error) { showConnection(false); }
}

for (const link of links) link.href = link.dataset.file + "?" + address;
for (const button of buttons) {
  button.addEventListener("click", () => {
    if (button.dataset.sure && !confirm(button.dataset.sure)) return;
    // A reset keeps the priors unless the person removes them.
    const texts = Object.entries(priors).map(([axis, prior]) => `${axis} = ${prior}`).join(", ");
    const isReset = button.dataset.request === "reset";
    if (isReset && texts && confirm(`Remove what was typed in, too? It is ${texts}.`)) post("forget");
    post(button.dataset.request);
  });
}

form.addEventListener("submit", (event) => {
  event.preventDefault();
  const values = new URLSearchParams(new FormData(form));
  values.set("axis", axisByHand.value);
  post("prior", "&" + values);
});
axisByHand.addEventListener("change", updateForm);
element("forget").addEventListener("click", () => post("forget", "&axis=" + axisByHand.value));

// Browsers permit sound only after a touch, hence the button.
sound.addEventListener("click", () => {
  audio = audio === null ? new AudioContext() : null;
  sound.textContent = audio ? "Sound: on" : "Sound: off";
  sound.setAttribute("aria-pressed", String(audio !== null));
});

// Keep the screen on. Browsers permit that only to pages over https or from the same computer.
function stayOn() {
  if (navigator.wakeLock && document.visibilityState === "visible") {
    navigator.wakeLock.request("screen").catch(() => {});
  }
}
document.addEventListener("visibilitychange", stayOn);
stayOn();
connect();
