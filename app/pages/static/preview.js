// What a correction would do to the part of the photo that is seen: soon in the middle of it, by the quick method, then
// in all of it. It is computed once for a place; the sliders mix it at once.

import { ask, byId, send } from "./common.js";

const MOST = 1_200_000; // pixels of a part that is computed: some seconds of work on one core
const PAUSE_MS = 250;
const SOON = [448, 336]; // pixels of what is seen first: about a second of work, half of it the same for any size
const WORKING = "Working out what a correction does here …";
const SLOW = "Still working. The first preview after an installation takes a minute or two.";
const SLOW_MS = 8000;
const LIGHT = Float32Array.from({ length: 256 }, (_, code) => {
  const value = code / 255;
  return value <= 0.04045 ? value / 12.92 : ((value + 0.055) / 1.055) ** 2.4;
});
const CODES = Uint8ClampedArray.from({ length: 4097 }, (_, step) => {
  const value = step / 4096;
  return 255 * (value <= 0.0031308 ? 12.92 * value : 1.055 * value ** (1 / 2.4) - 0.055);
});

async function pixelsOf(url) {
  const image = new Image();
  image.src = url;
  await image.decode();
  const canvas = new OffscreenCanvas(image.naturalWidth, image.naturalHeight);
  const context = canvas.getContext("2d", { willReadFrequently: true });
  context.drawImage(image, 0, 0);
  return context.getImageData(0, 0, canvas.width, canvas.height);
}

// Strength, texture and grain enter a correction linearly in light, but for its last bounds: so they are mixed.
export function mix({ before, after, smooth = after, clean = after }, { strength, texture, denoise }) {
  const mixed = new ImageData(before.width, before.height);
  const out = mixed.data;
  for (let i = 0; i < out.length; i += 4) {
    for (let k = i; k < i + 3; k += 1) {
      const a = LIGHT[after.data[k]];
      const b = LIGHT[smooth.data[k]];
      const wanted = b + texture * (a - b + denoise * (LIGHT[clean.data[k]] - a));
      const was = LIGHT[before.data[k]];
      const light = was + strength * (wanted - was);
      out[k] = CODES[light <= 0 ? 0 : light >= 1 ? 4096 : Math.round(light * 4096)];
    }
    out[i + 3] = 255;
  }
  return mixed;
}

export function setUpPreview(viewer) {
  const form = byId("correct");
  if (!viewer || !form || !("preview" in form.dataset)) return;
  const words = byId("preview-words");
  const canvas = Object.assign(document.createElement("canvas"), { className: "part" });
  const fields = form.elements;
  let [part, timer, running] = [null, 0, new AbortController()];
  let aim = null; // what is computed, or was last
  let wanted = !viewer.hasAfter; // a photo that is corrected already shows that until other settings are tried
  const value = (name) => Number(fields[name].value);
  // What texture and grain need takes as long again: only for those who move their sliders.
  const layered = () => value("texture") !== 1 || value("denoise") !== 0;
  const show = () => {
    if (!part) return;
    const mixed = mix(part.layers, { strength: value("strength"), texture: value("texture"), denoise: value("denoise") });
    [canvas.width, canvas.height] = [mixed.width, mixed.height];
    canvas.getContext("2d").putImageData(mixed, 0, 0);
    viewer.cover(canvas, part.region);
    if (viewer.mode === "before" && !viewer.hasAfter) viewer.setMode("split");
    viewer.hasAfter = true;
    viewer.hold(false);
    viewer.root.dataset.previewed = part.method;
  };
  const corrected = async ([region, method, layers], signal, say) => {
    const lens = fields.lens_id?.value;
    // not shared: it is deleted below, while the next page may be asking for the same already
    const nonce = crypto.getRandomValues(new Uint32Array(3)).join("-");
    const wish = { photo_id: form.dataset.photo, method, layers, nonce, output: { format: "png8", color_space: "srgb" } };
    const roi = inSensor(region, viewer, Number(form.dataset.orientation));
    const { id } = await send("POST", "/v1/corrections", { ...wish, roi, ...(lens ? { lens_id: lens } : {}) });
    try {
      const report = await settled(id, signal, say);
      const names = layers ? ["before", "after", "smooth", "clean"] : ["before", "after"];
      const pixels = await Promise.all(names.map((name) => pixelsOf(`/ui/corrections/${id}/layer/${name}`)));
      const gain = Math.max(...Object.values(report.zones).map((zone) => zone.expected_gain_db ?? 0));
      return { region, method, layered: layers, layers: Object.fromEntries(names.map((name, k) => [name, pixels[k]])), gain: report.nothing_to_correct ? 0 : gain };
    } finally {
      fetch(`/v1/corrections/${id}`, { method: "DELETE", keepalive: true }).catch(() => {}); // its pictures are here, or nobody waits
    }
  };
  const compute = async (region) => {
    running.abort();
    running = new AbortController();
    const { signal } = running;
    const [method, layers] = [fields.method.value, layered()];
    aim = { region, method, layered: layers };
    const steps = [[region, method, layers]];
    if (method === "standard" && !layers) steps.unshift([middle(region), "fast", false]);
    words.textContent = WORKING;
    try {
      for (const step of steps) {
        const made = await corrected(step, signal, (text) => step === steps[0] && (words.textContent = text));
        if (signal.aborted) return;
        part = made;
        show();
        if (made.gain < Number(form.dataset.least)) words.textContent = form.dataset.nothing;
        else if (step !== steps.at(-1)) words.textContent = "A quick first look; the better one is being made …";
        else words.textContent = seenWhole() ? "This is what you get. Sliders under More change it." : "The lower right shows what you get. Zoom in to see it elsewhere.";
        if (!made.gain) return;
      }
      if (layered() !== layers) look(); // a slider was moved meanwhile
    } catch (reason) {
      if (!signal.aborted) words.textContent = `No preview: ${reason.message}`;
    }
  };
  const seenWhole = () => viewer.region.width * viewer.region.height <= MOST;
  // Of a view that is too large to compute: from the middle to a corner, where lenses blur most.
  const lowerRight = () => {
    const width = Math.min(MOST, Math.ceil(viewer.width / 2));
    const height = Math.min(viewer.height, Math.max(1, Math.floor(MOST / width)));
    return { x: viewer.width - width, y: viewer.height - height, width, height };
  };
  const look = () => {
    clearTimeout(timer);
    if (!wanted || !viewer.viewport || fields.lens_id?.value === "") return;
    timer = setTimeout(() => {
      const region = seenWhole() ? viewer.region : lowerRight();
      if (!aim || aim.method !== fields.method.value || !covers(aim, region) || (layered() && !aim.layered)) compute(region);
    }, aim ? PAUSE_MS : 0); // the first look waits for nothing
  };
  viewer.onChange(look);
  form.addEventListener("input", () => {
    const first = !wanted;
    wanted = true;
    show();
    if (first || part) look();
  });
  fields.lens_id?.addEventListener("change", () => {
    aim = null;
    look();
  });
  window.addEventListener("pagehide", () => {
    running.abort();
    aim = null;
  });
  window.addEventListener("pageshow", (event) => event.persisted && look()); // back from another page: it was stopped
  look();
}

// Of each EXIF orientation: whether rows and columns change places, and which then count from the other end.
const TURNS = ["", "c", "rc", "r", "t", "tc", "trc", "tr"];

// A part of the upright photo in the coordinates of the sensor.
export function inSensor({ x, y, width, height }, upright, orientation) {
  const turn = TURNS[orientation - 1];
  const top = turn.includes("r") ? upright.height - y - height : y;
  const left = turn.includes("c") ? upright.width - x - width : x;
  return turn.includes("t") ? { x: top, y: left, width: height, height: width } : { x: left, y: top, width, height };
}

function covers({ region }, wanted) {
  const reaches = (at, size) => wanted[at] >= region[at] && wanted[at] + wanted[size] <= region[at] + region[size];
  return reaches("x", "width") && reaches("y", "height");
}

function middle({ x, y, width, height }) {
  const [w, h] = [Math.min(width, SOON[0]), Math.min(height, SOON[1])];
  return { x: x + Math.floor((width - w) / 2), y: y + Math.floor((height - h) / 2), width: w, height: h };
}

// Wait for the end of a correction; its report.
async function settled(id, signal, say) {
  const began = performance.now();
  for (let [tag, state, error] = ["", "queued", null]; ; ) {
    const response = await fetch(`/v1/jobs/${id}?wait=20`, { signal, headers: tag ? { "If-None-Match": tag } : {} });
    if (response.status !== 304) {
      tag = response.headers.get("ETag") ?? "";
      ({ state, error } = await response.json());
    }
    if (state === "succeeded") return (await (await ask(`/v1/corrections/${id}`, { signal })).json()).report;
    if (!["queued", "running"].includes(state)) throw new Error(error?.detail ?? "the preview was stopped");
    if (state === "queued") say("Waiting for other work to finish …");
    else say(performance.now() - began > SLOW_MS ? SLOW : WORKING);
  }
}
