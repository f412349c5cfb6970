// The windows in which the simulator processes a signal, as in the guide "ONNX and other runtimes".

export const SAMPLE_RATE = 16000;
export const WINDOW = 40960; // samples that the exported simulator takes
const STEP = 20480; // windows start on multiples of it
const CONTEXT = 3500; // samples on either side that the network needs
const HOP = Math.floor((WINDOW - 2 * CONTEXT) / STEP) * STEP;

// Length of a signal and the silence after it: the context that its end needs, and as much more as lets the last window
// end there.
export function paddedLength(length) {
  const shortest = Math.max(WINDOW, length + CONTEXT);
  return WINDOW + Math.ceil((shortest - WINDOW) / STEP) * STEP;
}

// Windows that cover a padded signal. Of the output of each, samples from `from` to `to` of the signal are used.
export function windowsOf(length) {
  const last = length - WINDOW;
  const windows = [];
  let from = 0;
  for (let start = 0; start < last; start += HOP) {
    const to = start + WINDOW - CONTEXT;
    windows.push({ start, from, to });
    from = to;
  }
  windows.push({ start: last, from, to: length });
  return windows;
}
