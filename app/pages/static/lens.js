// The lens: its map of blur, the blur at a point, its charts, and what is done with it.

import { acting, ask, byId, confirmed, send, withItsLens } from "./common.js";

// Brightness as the square root of light, as the map has it: faint tails stay visible.
function draw(canvas, rows) {
  const size = rows.length;
  const peak = Math.max(...rows.flat());
  canvas.width = canvas.height = size;
  const context = canvas.getContext("2d");
  const picture = context.createImageData(size, size);
  rows.flat().forEach((value, i) => {
    picture.data.fill(Math.round(255 * Math.sqrt(Math.max(0, value) / peak)), 4 * i, 4 * i + 3);
    picture.data[4 * i + 3] = 255;
  });
  context.putImageData(picture, 0, 0);
}

// Full width at half maximum of a Gaussian of the same spread.
function widthOf(rows) {
  const half = (rows.length - 1) / 2;
  let spread = 0;
  rows.forEach((row, y) => row.forEach((value, x) => (spread += value * ((x - half) ** 2 + (y - half) ** 2))));
  return 2.355 * Math.sqrt(spread / 2);
}

function tell(list, pairs) {
  list.replaceChildren(
    ...pairs.flatMap(([name, value]) => {
      const [term, words] = [document.createElement("dt"), document.createElement("dd")];
      term.textContent = name;
      words.textContent = value;
      return [term, words];
    }),
  );
}

// Cells of the map: as many as its shape holds, about 50 in all, fewer on a phone.
function gridFor(aspect, width) {
  const count = width < 500 ? 24 : 54;
  const rows = Math.max(2, Math.round(Math.sqrt(count / aspect)));
  return [Math.max(2, Math.round(rows * aspect)), rows];
}

export function setUpField() {
  const field = byId("field");
  if (!field) return;
  const controls = byId("field-controls");
  const [map, spot] = [field.querySelector("img"), field.querySelector(".spot")];
  const lens = `/v1/lenses/${field.dataset.lens}`;
  const aspect = Number(field.dataset.aspect);
  const [columns, rows] = gridFor(aspect, field.clientWidth);
  let [x, y] = [1 - 0.5 / columns, 0.5 / rows]; // the point, in shares of the picture
  let asked = 0;
  const settings = () => {
    const chosen = new URLSearchParams(new FormData(controls));
    for (const name of ["aperture", "version"]) if (!chosen.get(name)) chosen.delete(name);
    return chosen;
  };
  const showPoint = async () => {
    [spot.style.left, spot.style.top] = [`${x * 100}%`, `${y * 100}%`];
    const [right, up] = [(2 * x - 1) * aspect, 1 - 2 * y];
    const r = Math.min(1, Math.hypot(right, up) / Math.hypot(aspect, 1));
    const query = settings();
    query.set("r", r.toFixed(4));
    query.set("phi", Math.atan2(up, right).toFixed(4));
    for (const kind of ["json", "npy", "tiff"]) byId(`psf-${kind}`).href = `${lens}/psf.${kind}?${query}`;
    asked += 1;
    const mine = asked;
    let [answer, failed] = [null, null];
    try {
      answer = await (await ask(`${lens}/psf.json?${query}`)).json();
    } catch (reason) {
      failed = reason.message;
    }
    if (mine !== asked) return; // the point has moved on meanwhile
    const where = r < 0.02 ? "In the centre" : `${Math.round(r * 100)} % of the way to the corner`;
    if (failed) {
      byId("psf-words").textContent = failed;
      tell(byId("psf-numbers"), []);
      return;
    }
    const { psf, support } = answer;
    draw(byId("psf"), psf.data);
    const width = `${widthOf(psf.data).toFixed(1)} pixels`;
    byId("psf").setAttribute("aria-label", `Blur at the chosen point, ${width} wide`);
    byId("psf-words").textContent = support.extrapolated ? `${where}: beyond what photos showed, a guess` : where;
    const error = support.predicted_error === null ? "unknown" : `${Math.round(support.predicted_error * 100)} %`;
    tell(byId("psf-numbers"), [
      ["Width of a point", width],
      ["Size of the picture above", `${psf.data.length} pixels`],
      ["Seen in", `${support.photos} photo${support.photos === 1 ? "" : "s"}`],
      ["Based on", `about ${Math.round(support.effective_samples) || 1} sample${Math.round(support.effective_samples) > 1 ? "s" : ""}`],
      ["Expected error", error],
    ]);
  };
  const showField = () => {
    field.classList.add("loading");
    const query = settings();
    query.set("grid", `${columns}x${rows}`);
    query.set("aspect", aspect.toFixed(4));
    map.src = `${lens}/field.png?${query}`;
    showPoint();
  };
  for (const kind of ["load", "error"]) map.addEventListener(kind, () => field.classList.remove("loading"));
  map.addEventListener("load", () => (map.alt = "The blur of the lens over the picture"));
  field.addEventListener("click", (event) => {
    const box = field.getBoundingClientRect();
    [x, y] = [(event.clientX - box.left) / box.width, (event.clientY - box.top) / box.height];
    showPoint();
  });
  field.addEventListener("keydown", (event) => {
    const step = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[event.key];
    if (!step) return;
    event.preventDefault();
    x = Math.min(1, Math.max(0, x + step[0] / (2 * columns)));
    y = Math.min(1, Math.max(0, y + step[1] / (2 * rows)));
    showPoint();
  });
  controls.addEventListener("change", showField);
  controls.addEventListener("submit", (event) => event.preventDefault());
  showField();
}

// Charts of another aperture, or in another unit: drawn by the service.
export function setUpCharts() {
  const controls = byId("chart-controls");
  if (!controls) return;
  const holder = byId("charts");
  controls.addEventListener("submit", (event) => event.preventDefault());
  controls.addEventListener("change", async () => {
    holder.classList.add("loading");
    try {
      holder.innerHTML = await (await ask(`/ui/lenses/${controls.dataset.lens}/charts?${new URLSearchParams(new FormData(controls))}`)).text();
    } catch (reason) {
      holder.innerHTML = '<p class="alert" role="alert"></p>';
      holder.firstChild.textContent = reason.message;
    }
    holder.classList.remove("loading");
  });
}

async function putProfile(lens, file, how) {
  const headers = { "Content-Type": "application/zip" };
  const response = await ask(`${lens}/profile?${new URLSearchParams(how)}`, { method: "PUT", body: file, headers });
  for (;;) { // a worker reads it
    const { state, error } = await (await ask(`${response.headers.get("Location")}?wait=20`)).json();
    if (state === "succeeded") return true;
    if (error) throw Object.assign(new Error(error.detail), { code: error.code });
  }
}

// What is done with a lens as a whole, and a lens whose profile somebody gave away.
export function setUpLensActions() {
  acting(byId("add-lens"), async (fields) => {
    const [file, label] = [fields.get("profile"), fields.get("label").trim()];
    if (!label && !file.size) throw new Error("Give a name, or choose a profile.");
    const { id } = await send("POST", "/v1/lenses", { label: label || file.name.replace(/\.lensprofile$/i, "") });
    try {
      if (file.size) await putProfile(`/v1/lenses/${id}`, file, { rename: !label });
    } catch (reason) {
      await send("DELETE", `/v1/lenses/${id}`).catch(() => {}); // it may be gone with its profile
      throw reason;
    }
    return `/lenses/${id}`;
  });
  const holder = byId("lens-actions");
  const lens = `/v1/lenses/${holder?.dataset.lens}`;
  const acts = {
    rename: (fields) => send("PATCH", lens, { label: fields.get("label").trim() || null }).then(() => true),
    merge: async (fields) => {
      const into = fields.get("lens");
      if (!into) throw new Error("Choose the lens that this one is to be merged into.");
      if (!(await confirmed("All photos of this lens will count for the other one. This cannot be undone.", "Merge"))) return "";
      const merged = await withItsLens((any) => send("PATCH", lens, { merge_into: into, any_lens: any }));
      return merged && `/lenses/${into}`;
    },
    upload: (fields) => {
      if (!fields.get("profile").size) throw new Error("Choose a profile first.");
      return withItsLens((any) => putProfile(lens, fields.get("profile"), { any_lens: any }));
    },
    delete: async () => {
      const question = "Delete this lens and everything learned from its photos? The photos themselves are kept.";
      return (await confirmed(question, "Delete the lens")) && send("DELETE", lens).then(() => "/");
    },
  };
  for (const form of holder?.querySelectorAll("form") ?? []) acting(form, acts[form.dataset.act], holder.querySelector(".alert"));
}
