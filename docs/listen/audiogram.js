// An audiogram whose points can be dragged, or moved with the arrow keys.

export const FREQUENCIES = [250, 500, 1000, 2000, 3000, 4000, 6000, 8000];
export const LOWEST = -10; // dB HL
export const HIGHEST = 100; // dB HL, where the simulator ends
const STEP = 5;

// Bisgaard, Vlaming, Dahlquist 2010, as hlsim.audiogram.STANDARD; N7 is beyond the simulator's range.
export const STANDARD = {
  Normal: { name: "Normal hearing", thresholds: [0, 0, 0, 0, 0, 0, 0, 0] },
  N1: { name: "N1: very mild loss", thresholds: [10, 10, 10, 15, 20, 30, 40, 40] },
  N2: { name: "N2: mild loss", thresholds: [20, 20, 25, 35, 40, 45, 50, 50] },
  N3: { name: "N3: moderate loss", thresholds: [35, 35, 40, 50, 55, 60, 65, 65] },
  N4: { name: "N4: moderate to severe loss", thresholds: [55, 55, 55, 65, 70, 75, 80, 80] },
  N5: { name: "N5: severe loss", thresholds: [65, 70, 75, 80, 80, 80, 80, 80] },
  N6: { name: "N6: very severe loss", thresholds: [75, 80, 85, 90, 95, 100, 100, 100] },
  S1: { name: "S1: very mild loss, steep at high pitches", thresholds: [10, 10, 10, 15, 30, 55, 70, 70] },
  S2: { name: "S2: mild loss, steep at high pitches", thresholds: [20, 20, 25, 55, 75, 95, 95, 95] },
  S3: { name: "S3: moderate to severe loss, steep", thresholds: [30, 35, 60, 75, 80, 80, 85, 85] },
};

// Average speech at 65 dB SPL in thirds of an octave (Byrne et al. 1994) minus the threshold of hearing in a free field
// (ISO 389-7), in dB HL. Speech goes about 15 dB above and below it.
const SPEECH = [44, 53, 46, 45, 48, 46, 35, 26];
const SPEECH_RANGE = 15;

const WIDTH = 400;
const HEIGHT = 362;
const LEFT = 44;
const RIGHT = 386;
const TOP = 46;
const BOTTOM = 350;

const xOf = (hertz) => LEFT + 18 + ((RIGHT - LEFT - 36) * Math.log2(hertz / 250)) / Math.log2(8000 / 250);
const yOf = (level) => TOP + ((BOTTOM - TOP) * (level - LOWEST)) / (HIGHEST - LOWEST);
const levelAt = (y) => LOWEST + ((y - TOP) * (HIGHEST - LOWEST)) / (BOTTOM - TOP);
const clamp = (level) => Math.min(HIGHEST, Math.max(LOWEST, level));

export function parseThresholds(text) {
  const values = text.split(",").map((part) => (part.trim() === "" ? NaN : Number(part)));
  const valid = values.length === FREQUENCIES.length && values.every((value) => value >= LOWEST && value <= HIGHEST);
  return valid ? values.map(Math.round) : null;
}

function element(name, attributes, text) {
  const node = document.createElementNS("http://www.w3.org/2000/svg", name);
  for (const [key, value] of Object.entries(attributes)) node.setAttribute(key, value);
  if (text !== undefined) node.textContent = text;
  return node;
}

export class AudiogramChart extends EventTarget {
  constructor(svg, thresholds) {
    super();
    this.svg = svg;
    this.thresholds = [...thresholds];
    svg.setAttribute("viewBox", `0 0 ${WIDTH} ${HEIGHT}`);
    this._drawGrid();
    this.curve = svg.appendChild(element("polyline", { class: "curve" }));
    this.points = FREQUENCIES.map((hertz, index) => this._addPoint(hertz, index));
    svg.addEventListener("pointerdown", (event) => this._press(event));
    svg.addEventListener("pointermove", (event) => this._drag(event));
    for (const name of ["pointerup", "pointercancel"]) svg.addEventListener(name, () => (this.dragged = null));
    this._update();
  }

  // Move all points, without an event.
  set(thresholds) {
    this.thresholds = [...thresholds];
    this._update();
  }

  _drawGrid() {
    const low = FREQUENCIES.map((hertz, i) => `${xOf(hertz)},${yOf(SPEECH[i] - SPEECH_RANGE)}`);
    const high = FREQUENCIES.map((hertz, i) => `${xOf(hertz)},${yOf(SPEECH[i] + SPEECH_RANGE)}`);
    this.svg.append(
      element("rect", { class: "normal", x: LEFT, y: yOf(LOWEST), width: RIGHT - LEFT, height: yOf(20) - yOf(LOWEST) }),
      element("polygon", { class: "speech", points: [...low, ...high.reverse()].join(" ") }),
    );
    for (let level = 0; level <= HIGHEST; level += 20) {
      const y = yOf(level);
      this.svg.append(
        element("line", { class: "grid", x1: LEFT, x2: RIGHT, y1: y, y2: y }),
        element("text", { class: "tick", x: LEFT - 7, y: y + 4, "text-anchor": "end" }, level),
      );
    }
    for (const hertz of FREQUENCIES) {
      const x = xOf(hertz);
      const label = hertz < 1000 ? hertz : `${hertz / 1000}k`;
      this.svg.append(
        element("line", { class: "grid", x1: x, x2: x, y1: TOP, y2: BOTTOM }),
        element("text", { class: "tick", x, y: TOP - 8, "text-anchor": "middle" }, label),
      );
    }
    const middle = (TOP + BOTTOM) / 2;
    this.svg.append(
      element("text", { class: "axis", x: LEFT, y: 16 }, "low pitch"),
      element("text", { class: "axis", x: RIGHT, y: 16, "text-anchor": "end" }, "high pitch (Hz)"),
      element("text", { class: "area", x: RIGHT - 6, y: yOf(-10) + 15, "text-anchor": "end" }, "normal hearing"),
      element("text", { class: "area", x: xOf(600), y: yOf(60) + 4, "text-anchor": "middle" }, "speech"),
      element(
        "text",
        { class: "axis", x: 0, y: 0, "text-anchor": "middle", transform: `translate(12 ${middle}) rotate(-90)` },
        "← only loud sounds heard (dB HL)",
      ),
    );
  }

  _addPoint(hertz, index) {
    const point = element("g", {
      class: "point",
      role: "slider",
      tabindex: 0,
      "aria-orientation": "vertical",
      "aria-label": `Softest sound heard at ${hertz} hertz`,
      "aria-valuemin": LOWEST,
      "aria-valuemax": HIGHEST,
    });
    point.append(
      element("circle", { class: "target", r: 22 }),
      element("circle", { class: "ring", r: 13 }),
      element("circle", { class: "dot", r: 8 }),
      element("text", { class: "value", y: -20, "text-anchor": "middle" }),
    );
    point.addEventListener("keydown", (event) => this._key(event, index));
    this.svg.append(point);
    return point;
  }

  // The arrows up and down move a point up and down on the page, so down is more loss. Right and left are more and less.
  _key(event, index) {
    const level = this.thresholds[index];
    const levels = {
      ArrowDown: level + STEP,
      ArrowRight: level + STEP,
      ArrowUp: level - STEP,
      ArrowLeft: level - STEP,
      PageDown: level + 4 * STEP,
      PageUp: level - 4 * STEP,
      Home: LOWEST,
      End: HIGHEST,
    };
    if (!(event.key in levels)) return;
    event.preventDefault();
    this._move(index, levels[event.key]);
  }

  _place(event) {
    const box = this.svg.getBoundingClientRect();
    const scale = WIDTH / box.width;
    return { x: (event.clientX - box.left) * scale, y: (event.clientY - box.top) * scale };
  }

  _press(event) {
    const { x, y } = this._place(event);
    const distances = FREQUENCIES.map((hertz) => Math.abs(xOf(hertz) - x));
    const index = distances.indexOf(Math.min(...distances));
    const onPoint = event.target.closest(".point") !== null;
    if (!onPoint && (y < TOP || y > BOTTOM || x < LEFT || x > RIGHT)) return;
    // A finger beside the points may be scrolling.
    if (!onPoint && event.pointerType === "touch") return;
    event.preventDefault();
    this.dragged = index;
    this.svg.setPointerCapture(event.pointerId);
    this.points[index].focus();
    this._drag(event);
  }

  _drag(event) {
    if (this.dragged === null || this.dragged === undefined) return;
    const level = Math.round(levelAt(this._place(event).y) / STEP) * STEP;
    this._move(this.dragged, level);
  }

  _move(index, level) {
    if (this.thresholds[index] === clamp(level)) return;
    this.thresholds[index] = clamp(level);
    this._update();
    this.dispatchEvent(new Event("change"));
  }

  _update() {
    const places = this.thresholds.map((level, i) => `${xOf(FREQUENCIES[i])},${yOf(level)}`);
    this.curve.setAttribute("points", places.join(" "));
    this.points.forEach((point, i) => {
      const level = this.thresholds[i];
      point.setAttribute("transform", `translate(${places[i]})`);
      point.setAttribute("aria-valuenow", level);
      point.setAttribute("aria-valuetext", `${level} decibels`);
      point.querySelector(".value").textContent = `${level} dB HL`;
    });
  }
}
