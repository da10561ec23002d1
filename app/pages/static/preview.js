// What a correction would do to the part of the photo that is seen: computed once for a place, mixed at once by the sliders.

import { byId, failure, send } from "./common.js";

const MOST = 1_200_000; // pixels of a part that is computed: some seconds of work on one core
const PAUSE_MS = 500;
const WORKING = "Working out what a correction does here …";
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
  const canvas = document.createElement("canvas");
  let [part, asked, timer, running] = [null, 0, 0, ""];
  const forget = (id) => fetch(`/v1/corrections/${id}`, { method: "DELETE", keepalive: true }).catch(() => {}); // it may be gone
  const left = new Set();
  // What nobody waits for any more stops; but the same wish again is the same correction.
  const sweep = () => {
    for (const id of left) if (id !== running) forget(id);
    left.clear();
  };
  const leave = () => {
    if (running) left.add(running);
    running = "";
  };
  const value = (name) => Number(form.elements[name].value);
  // What texture and grain need takes as long again: only for those who move their sliders.
  const layered = () => value("texture") !== 1 || value("denoise") !== 0;
  const show = () => {
    if (!part) return;
    const mixed = mix(part.layers, { strength: value("strength"), texture: value("texture"), denoise: value("denoise") });
    [canvas.width, canvas.height] = [mixed.width, mixed.height];
    canvas.getContext("2d").putImageData(mixed, 0, 0);
    const first = viewer.patches.length === 0;
    viewer.patches = [{ ...part.region, image: canvas }];
    if (first && viewer.mode === "before") viewer.setMode("split");
    viewer.redraw();
    viewer.root.dataset.previewed = "";
  };
  const covers = ({ region }, wanted) =>
    wanted.x >= region.x &&
    wanted.y >= region.y &&
    wanted.x + wanted.width <= region.x + region.width &&
    wanted.y + wanted.height <= region.y + region.height;
  const compute = async (region) => {
    asked += 1;
    const [mine, layers] = [asked, layered()];
    leave();
    words.textContent = WORKING;
    try {
      const lens = form.elements.lens_id?.value;
      const made = await send("POST", `/ui/photos/${form.dataset.photo}/preview`, {
        ...region,
        layers,
        ...(lens ? { lens_id: lens } : {}),
      });
      if (mine !== asked) {
        left.add(made.id);
        if (running) sweep();
        return;
      }
      running = made.id;
      sweep();
      const end = await settled(made.id, (job) => {
        if (mine === asked) words.textContent = job.state === "queued" ? "Waiting for other work to finish …" : WORKING;
        return mine === asked;
      });
      if (mine !== asked) return;
      if (end.state !== "succeeded") throw new Error(end.error?.detail ?? "the preview was stopped");
      const base = `/ui/corrections/${made.id}/layer`;
      const names = layers ? ["before", "after", "smooth", "clean"] : ["before", "after"];
      const pixels = await Promise.all(names.map((name) => pixelsOf(`${base}/${name}`)));
      if (mine !== asked) return;
      running = "";
      part = { region, layered: layers, layers: Object.fromEntries(names.map((name, k) => [name, pixels[k]])) };
      words.textContent = end.untouched
        ? form.dataset.nothing
        : !seenWhole()
          ? "The lower right shows what you get. Zoom in to see it elsewhere."
          : "This is what you get. Sliders under More change it.";
      show();
      forget(made.id); // its pictures are here now
      if (layered() !== layers) look(); // a slider was moved meanwhile
    } catch (reason) {
      if (mine !== asked) return;
      leave();
      sweep();
      words.textContent = `No preview: ${reason.message}`;
    }
  };
  const seenWhole = () => viewer.region.width * viewer.region.height <= MOST;
  // Of a view that is too large to compute: from the middle to a corner, where lenses blur most.
  const lowerRight = () => {
    const width = Math.min(MOST, Math.ceil(viewer.width / 2));
    const height = Math.min(viewer.height, Math.max(1, Math.floor(MOST / width)));
    return { x: viewer.width - width, y: viewer.height - height, width, height };
  };
  let wanted = !viewer.after; // a photo that is corrected already shows that until other settings are tried
  const look = () => {
    clearTimeout(timer);
    if (!wanted || form.elements.lens_id?.value === "") return;
    timer = setTimeout(() => {
      const region = seenWhole() ? viewer.region : lowerRight();
      if (part && covers(part, region) && (part.layered || !layered())) return;
      compute(region);
    }, PAUSE_MS);
  };
  viewer.onChange(look);
  form.addEventListener("input", () => {
    const first = !wanted;
    wanted = true;
    show();
    if (first || (part && layered() && !part.layered)) look();
  });
  form.elements.lens_id?.addEventListener("change", () => {
    part = null;
    look();
  });
  window.addEventListener("pagehide", () => {
    leave();
    sweep();
  });
  window.addEventListener("pageshow", (event) => event.persisted && look()); // back from another page: it was stopped
  look();
}

// Wait for the end of a job; `heard` is told each state and says whether anybody still waits.
async function settled(id, heard) {
  let [tag, job] = ["", { state: "queued" }];
  for (;;) {
    const response = await fetch(`/v1/jobs/${id}?wait=20`, { headers: tag ? { "If-None-Match": tag } : {} });
    if (response.status !== 304 && !response.ok) throw failure(await response.text(), response.status);
    if (response.status !== 304) {
      tag = response.headers.get("ETag") ?? "";
      job = await response.json();
      if (["succeeded", "failed", "cancelled"].includes(job.state)) {
        const correction = await (await fetch(`/v1/corrections/${id}`)).json();
        return { ...job, untouched: correction.report?.nothing_to_correct };
      }
    }
    if (!heard(job)) return { state: "left" };
  }
}
