// The page: an ear, a sound, and three ways to hear it.

import { AudiogramChart, FREQUENCIES, HIGHEST, LOWEST, STANDARD, parseThresholds } from "./audiogram.js";
import { compensate, simulate } from "./engine.js";
import { LIVE_DELAY, Live, record } from "./microphone.js";
import { Player } from "./player.js";
import { LONGEST_SECONDS, decode, levelOf, present } from "./sound.js";
import { drawSpectrogram } from "./spectrogram.js";
import { SAMPLE_RATE } from "./windows.js";

const SPEECH = [
  { file: "flite-rms-01", sentence: "The ferry leaves at six, so pack your scarf and boots tonight." },
  { file: "flite-slt-03", sentence: "Would you measure the width of this narrow path for me?" },
  { file: "espeak-us-annie-01", sentence: "Jane whispered a joke and the whole choir began to laugh." },
  { file: "flite-awb-01", sentence: "A boat with yellow oars drifted beneath the stone bridge." },
];
const VERSIONS = {
  normal: { title: "Normal hearing", short: "Normal", about: "a healthy ear" },
  ear: { title: "This ear", short: "This ear", about: "the ear that you chose, without help" },
  aided: { title: "This ear with a hearing aid", short: "With aid", about: "the aid’s output, heard by the same ear" },
};
const FIRST_EAR = "N3";
const RECORDED_SECONDS = 5;
const SOFTEST_SPL = 5; // level in dB SPL below which speech is not heard
const SOFT_SPL = 30; // level in dB SPL below which a listener is tempted to turn the volume up
const HIGHEST_LATE_SHARE = 0.1; // of the blocks of the live aid
const DRAG_PAUSE = 120; // milliseconds without a movement after which the sounds follow
const PLAY = '<svg viewBox="0 0 24 24" aria-hidden="true"><path d="M7 4v16l13-8z"/></svg>';
const PAUSE = '<svg viewBox="0 0 24 24" aria-hidden="true"><path d="M6 5h4v14H6zM14 5h4v14h-4z"/></svg>';

const $ = (id) => document.getElementById(id);
const volumeOf = () => ($("volume").value / 100) ** 2;

const chart = new AudiogramChart($("audiogram"), thresholdsOfLink() ?? STANDARD[FIRST_EAR].thresholds);
const player = new Player(volumeOf());
const cards = {};

// Pascals by version, and the sound from which they are computed.
export const state = { sound: null, results: {} };

let wanted = null; // version that shall play as soon as it is computed
let choices = 0; // number of sounds that were chosen
let computation = new AbortController();
let timer = 0;
let live = null;

// The ear

function settingOfLink(name) {
  return new URLSearchParams(location.hash.slice(1)).get(name);
}

function thresholdsOfLink() {
  const text = settingOfLink("ear");
  if (text === null) return null;
  const thresholds = parseThresholds(text);
  if (thresholds === null) $("shared").textContent = `The link has no ear: it needs eight levels from ${LOWEST} to ${HIGHEST} dB HL.`;
  return thresholds;
}

// The link never sets the volume, which is the listener's own.
function writeLink() {
  history.replaceState(null, "", `#ear=${chart.thresholds.join(",")}&speech=${$("speech").value}`);
}

function showEar() {
  const distanceTo = (key) =>
    STANDARD[key].thresholds.reduce((sum, level, i) => sum + Math.abs(level - chart.thresholds[i]), 0);
  const [closest] = Object.keys(STANDARD).sort((a, b) => distanceTo(a) - distanceTo(b));
  const isStandard = distanceTo(closest) === 0;
  for (const button of $("presets").children) {
    button.setAttribute("aria-pressed", isStandard && button.textContent === closest);
  }
  const { name } = STANDARD[closest];
  write("ear-name", isStandard ? name : `Your own ear, closest to ${name}`);
  chart.thresholds.forEach((level, i) => {
    const input = $("numbers").querySelectorAll("input")[i];
    if (document.activeElement !== input) input.value = level;
  });
}

function changeEar() {
  showEar();
  writeLink();
  $("shared").textContent = "";
  for (const name of ["ear", "aided"]) cards[name].setAttribute("aria-busy", "true");
  clearTimeout(timer);
  // The live aid needs the models in time, so the other sounds wait until it stops.
  if (live !== null) live.fit(chart.thresholds);
  else timer = setTimeout(compute, DRAG_PAUSE);
}

function setEar(thresholds) {
  chart.set(thresholds);
  changeEar();
}

// The three versions

async function compute() {
  computation.abort();
  computation = new AbortController();
  const { signal: abort } = computation;
  const { sound } = state;
  const thresholds = [...chart.thresholds];
  if (sound === null) return;
  const steps = {
    normal: () => simulate(sound, STANDARD.Normal.thresholds, abort),
    ear: () => simulate(sound, thresholds, abort),
    aided: async () => simulate(await compensate(sound, thresholds, abort), thresholds, abort),
  };
  if (state.results.normal) delete steps.normal;
  try {
    const first = player.playing ?? wanted;
    const names = Object.keys(steps);
    names.sort((a, b) => (b === first) - (a === first));
    for (const name of names) {
      const pascals = await steps[name]();
      abort.throwIfAborted();
      show(name, pascals);
    }
    say("");
    document.body.dataset.ready = "true";
  } catch (error) {
    if (!abort.aborted) fail(error);
  }
}

function show(name, pascals) {
  state.results[name] = pascals;
  player.set(name, pascals);
  drawSpectrogram(cards[name].querySelector("canvas"), pascals);
  cards[name].setAttribute("aria-busy", "false");
  for (const [version, card] of Object.entries(cards)) {
    const loudness = describeLoudness(version);
    card.querySelector(".loudness").textContent = loudness;
    card.querySelector("canvas").setAttribute("aria-label", `Spectrogram of ${VERSIONS[version].title}: ${loudness}`);
  }
  if (wanted === name) {
    wanted = null;
    player.play(name);
  }
}

function describeLoudness(name) {
  const { normal, [name]: perceived } = state.results;
  if (name === "normal" || !normal || !perceived) return VERSIONS[name].about;
  const level = levelOf(perceived);
  const difference = Math.round(level - levelOf(normal));
  if (Math.abs(difference) <= 1) return "as loud as for a healthy ear";
  const size = `${Math.abs(difference)} dB ${difference > 0 ? "louder" : "softer"} than for a healthy ear`;
  if (level >= SOFT_SPL) return size;
  const silence = level < SOFTEST_SPL ? "not heard at all" : size;
  return `${silence}. Do not turn the volume up: this silence is the hearing loss.`;
}

function addCard(name) {
  const card = document.createElement("section");
  card.className = "version";
  card.id = `version-${name}`;
  card.setAttribute("aria-busy", "true");
  card.innerHTML = `
    <div class="head">
      <button type="button" class="play">${PLAY}</button>
      <div class="text"><h3></h3><div class="loudness"></div></div>
    </div>
    <div class="picture">
      <canvas role="img" width="480" height="128"></canvas>
      <span class="high" aria-hidden="true">high pitch</span><span class="low" aria-hidden="true">low</span>
      <div class="head-line"></div>
    </div>`;
  card.querySelector("h3").textContent = VERSIONS[name].title;
  card.querySelector(".loudness").textContent = VERSIONS[name].about;
  card.querySelector(".play").addEventListener("click", () => press(name));
  cards[name] = card;
  $("versions").append(card);
  // On a narrow screen, the same buttons are always in reach.
  const button = document.createElement("button");
  button.type = "button";
  button.dataset.version = name;
  button.addEventListener("click", () => press(name));
  $("dock").append(button);
}

async function press(name) {
  player.context.resume(); // A browser allows sound only now, while the button is pressed.
  await stopLive();
  if (player.playing === name) player.stop();
  else if (player.has(name)) player.play(name);
  else if (cards[name].getAttribute("aria-busy") === "true") {
    wanted = name;
    say("The sound comes as soon as it is computed …");
  } else say("There is no sound to play. Choose one, or reload the page.");
}

player.onchange = () => {
  for (const [name, card] of Object.entries(cards)) {
    const playing = player.playing === name;
    card.classList.toggle("playing", playing);
    const button = card.querySelector(".play");
    button.innerHTML = playing ? PAUSE : PLAY;
    button.setAttribute("aria-label", `${playing ? "Stop" : "Play"}: ${VERSIONS[name].title}`);
    const docked = $("dock").querySelector(`[data-version=${name}]`);
    docked.innerHTML = `${playing ? PAUSE : PLAY} ${VERSIONS[name].short}`;
    docked.setAttribute("aria-pressed", playing);
  }
  if (player.playing !== null) requestAnimationFrame(moveHead);
};

function moveHead() {
  if (player.playing === null) return;
  const share = player.position / player.duration;
  cards[player.playing].querySelector(".head-line").style.left = `${100 * share}%`;
  requestAnimationFrame(moveHead);
}

// The sound

async function setSound(promise, name, file = "") {
  const choice = ++choices;
  const before = state.sourceName;
  try {
    const samples = present(await promise);
    if (choice !== choices) return; // Another sound was chosen meanwhile.
    wanted = player.playing ?? wanted;
    player.clear();
    state.sound = samples;
    state.results = {};
    $("speech").value = file; // No sentence is selected beside a file or a recording, so that each can be chosen again.
    const seconds = samples.length / SAMPLE_RATE;
    const cut = seconds === LONGEST_SECONDS ? `, the first ${LONGEST_SECONDS} seconds` : "";
    state.sourceName = `${name}${cut}`;
    write("source-name", state.sourceName);
    for (const card of Object.values(cards)) card.setAttribute("aria-busy", "true");
    await compute();
  } catch (error) {
    if (choice !== choices) return; // The message would stand beside another sound.
    write("source-name", before ? `${error.message} You still hear: ${before}` : error.message);
    say("");
    if (state.sound === null) for (const card of Object.values(cards)) card.setAttribute("aria-busy", "false");
  }
}

async function bundledSpeech(file) {
  const response = await fetch(`assets/speech/${file}.flac`);
  if (!response.ok) throw new Error("The speech could not be loaded. Reload the page.");
  return decode(await response.arrayBuffer());
}

function chooseSpeech() {
  const { value, selectedOptions } = $("speech");
  return setSound(bundledSpeech(value), `“${selectedOptions[0].text}” (a computer’s voice)`, value);
}

function setSpeechOfLink() {
  const file = settingOfLink("speech") ?? "";
  const isNew = file !== $("speech").value && SPEECH.some((speech) => speech.file === file);
  if (isNew) $("speech").value = file;
  return isNew;
}

async function recordSound() {
  const button = $("record");
  const label = button.textContent;
  button.disabled = true;
  player.stop();
  await stopLive();
  const showTime = (seconds) => (button.textContent = `Speak … ${Math.ceil(RECORDED_SECONDS - seconds)} s`);
  await setSound(record(RECORDED_SECONDS, showTime), "Your recording");
  button.textContent = label;
  button.disabled = false;
}

// Live

async function startLive() {
  player.stop();
  live = new Live();
  $("live").textContent = "Stop";
  $("live-status").textContent = "Starting …";
  try {
    await live.start(chart.thresholds, volumeOf(), showLive);
  } catch (error) {
    live = null;
    $("live").textContent = "Start";
    $("live-status").textContent = `${error.message} You can record instead, and listen afterwards.`;
  }
}

async function stopLive() {
  if (live === null) return;
  const stopped = live;
  live = null;
  $("live").textContent = "Start";
  $("live-status").textContent = "";
  await stopped.stop();
  await compute();
}

function showLive(late) {
  if (live === null) return;
  let text = `On. ${Math.round(LIVE_DELAY)} ms later than the sound card alone.`;
  if (late > HIGHEST_LATE_SHARE) text += " This device is too slow: parts are missing. Record instead.";
  write("live-status", text);
}

// Messages

// Screen readers read a text again when it is written, so it is written only when it changes.
function write(id, text) {
  if ($(id).textContent !== text) $(id).textContent = text;
}

function say(text) {
  $("status").textContent = text;
}

function fail(error) {
  say(error.message);
  for (const card of Object.values(cards)) card.setAttribute("aria-busy", "false");
  document.body.dataset.failed = error.message;
}

// Start

$("unbuilt").remove(); // It is for browsers that cannot load this file.
for (const key of Object.keys(STANDARD)) {
  const button = document.createElement("button");
  button.type = "button";
  button.textContent = key;
  button.title = STANDARD[key].name;
  button.addEventListener("click", () => setEar(STANDARD[key].thresholds));
  $("presets").append(button);
}
FREQUENCIES.forEach((hertz, i) => {
  const label = document.createElement("label");
  label.textContent = `${hertz} Hz`;
  const input = document.createElement("input");
  Object.assign(input, { type: "number", min: LOWEST, max: HIGHEST, step: 5 });
  input.setAttribute("aria-label", `Level at ${hertz} hertz in decibels`);
  input.addEventListener("change", () => {
    const thresholds = [...chart.thresholds];
    const level = input.value === "" ? thresholds[i] : Number(input.value);
    thresholds[i] = Math.round(Math.min(HIGHEST, Math.max(LOWEST, level)));
    input.value = thresholds[i];
    setEar(thresholds);
    if (thresholds[i] !== Math.round(level)) $("shared").textContent = `Levels go from ${LOWEST} to ${HIGHEST} dB HL.`;
  });
  label.append(input);
  $("numbers").append(label);
});
for (const { file, sentence } of SPEECH) $("speech").add(new Option(sentence, file));
setSpeechOfLink();
for (const name of Object.keys(VERSIONS)) addCard(name);
player.onchange();
player.setRepeat($("repeat").checked);
showEar();

chart.addEventListener("change", changeEar);
addEventListener("keydown", (event) => {
  const name = Object.keys(VERSIONS)[Number(event.key) - 1];
  const typing = event.target.closest?.("input") || event.ctrlKey || event.altKey || event.metaKey;
  if (name !== undefined && !typing) press(name);
});
addEventListener("hashchange", () => {
  const thresholds = thresholdsOfLink();
  if (setSpeechOfLink()) chooseSpeech();
  if (thresholds !== null && `${thresholds}` !== `${chart.thresholds}`) setEar(thresholds);
});
$("speech").addEventListener("change", () => {
  writeLink();
  chooseSpeech();
});
$("file").addEventListener("change", () => {
  const [file] = $("file").files;
  if (file) write("source-name", `Reading ${file.name} …`);
  if (file) setSound(file.arrayBuffer().then(decode), file.name);
});
$("record").addEventListener("click", recordSound);
$("repeat").addEventListener("change", () => player.setRepeat($("repeat").checked));
$("volume").addEventListener("input", () => {
  player.setVolume(volumeOf());
  live?.setVolume(volumeOf());
});
$("headphones").addEventListener("change", () => {
  $("live").disabled = !$("headphones").checked;
  if (!$("headphones").checked) stopLive();
});
$("live").addEventListener("click", () => (live === null ? startLive() : stopLive()));
$("share").addEventListener("click", async () => {
  writeLink();
  const copied = await navigator.clipboard?.writeText(location.href).then(() => true, () => false);
  $("shared").textContent = copied ? "Copied." : "Copy the address of this page.";
});

say("Loading the ear and the hearing aid …");
chooseSpeech();
