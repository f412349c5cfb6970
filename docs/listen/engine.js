// The simulator and the hearing aid, for whole signals in pascals at 16 kHz.

import { SAMPLE_RATE, WINDOW, paddedLength, windowsOf } from "./windows.js";

const AID_DELAY = 64; // samples
const AID_CHUNK = SAMPLE_RATE; // samples per request, a multiple of the aid's block

const worker = new Worker(new URL("./worker.js", import.meta.url), { type: "module" });
const pending = new Map();
let requests = 0;

worker.onmessage = ({ data: { id, result, error } }) => {
  const { resolve, reject } = pending.get(id);
  pending.delete(id);
  if (error === undefined) resolve(result);
  else reject(new Error(error));
};

worker.onerror = () => {
  for (const { reject } of pending.values()) reject(new Error("This browser cannot start the ear and the hearing aid. Try a newer one."));
  pending.clear();
};

export function request(name, parameters = {}, transferred = []) {
  return new Promise((resolve, reject) => {
    const id = requests++;
    pending.set(id, { resolve, reject });
    worker.postMessage({ id, name, ...parameters }, transferred);
  });
}

// What the ear perceives, equally long and without delay.
export async function simulate(signal, thresholds, abort) {
  const padded = new Float32Array(paddedLength(signal.length));
  padded.set(signal);
  const perceived = new Float32Array(padded.length);
  for (const { start, from, to } of windowsOf(padded.length)) {
    abort?.throwIfAborted();
    const samples = padded.slice(start, start + WINDOW);
    const output = await request("simulate", { samples, thresholds }, [samples.buffer]);
    perceived.set(output.subarray(from - start, to - start), from);
  }
  return perceived.subarray(0, signal.length);
}

// The output of the hearing aid, equally long and without delay.
export async function compensate(signal, thresholds, abort) {
  abort?.throwIfAborted();
  await request("openAid", { thresholds });
  const chunks = Math.ceil((signal.length + AID_DELAY) / AID_CHUNK);
  const padded = new Float32Array(chunks * AID_CHUNK);
  padded.set(signal);
  const output = new Float32Array(padded.length);
  for (let start = 0; start < padded.length; start += AID_CHUNK) {
    abort?.throwIfAborted();
    const samples = padded.slice(start, start + AID_CHUNK);
    output.set(await request("compensate", { samples }, [samples.buffer]), start);
  }
  return output.subarray(AID_DELAY, AID_DELAY + signal.length);
}
