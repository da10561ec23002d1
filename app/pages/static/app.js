// Behaviour of the pages. Each part looks for its own element and does nothing where there is none.

const byId = (id) => document.getElementById(id);

async function problemText(response) {
  try {
    const problem = await response.json();
    const first = problem.errors?.[0]?.message;
    return first && !problem.detail.includes(first) ? `${problem.detail}: ${first}` : problem.detail;
  } catch {
    return `The service answered ${response.status}. Try again in a moment.`;
  }
}

async function send(method, url, body) {
  const response = await fetch(url, {
    method,
    headers: { "Content-Type": "application/json" },
    body: JSON.stringify(body),
  });
  if (!response.ok) throw new Error(await problemText(response));
  return response.json();
}

// --- upload -------------------------------------------------------------------------------------

function uploadOne(file, calibrate, list) {
  const item = document.createElement("li");
  item.innerHTML = '<div class="grow"><span></span><p></p><progress max="1" value="0"></progress></div>';
  const [name, words, bar] = [item.querySelector("span"), item.querySelector("p"), item.querySelector("progress")];
  name.textContent = file.name;
  words.textContent = "Waiting to be sent";
  bar.setAttribute("aria-label", `Upload of ${file.name}`);
  list.append(item);
  return () =>
    new Promise((resolve) => {
      const request = new XMLHttpRequest();
      const query = new URLSearchParams({ filename: file.name, calibrate: String(calibrate) });
      request.open("POST", `/v1/photos?${query}`);
      request.setRequestHeader("Content-Type", "application/octet-stream");
      request.upload.onprogress = (event) => {
        bar.value = event.total ? event.loaded / event.total : 0;
        words.textContent = `Sending, ${Math.round(bar.value * 100)} %`;
      };
      const fail = (text) => {
        bar.remove();
        words.className = "error";
        words.textContent = text;
        resolve(false);
      };
      request.onerror = () => fail("The connection was lost. Choose the photo again; nothing is counted twice.");
      request.onload = () => {
        if (request.status === 202 || request.status === 200) {
          item.remove();
          resolve(true);
          return;
        }
        try {
          fail(JSON.parse(request.responseText).detail);
        } catch {
          fail(`The service answered ${request.status}.`);
        }
      };
      request.send(file);
    });
}

function setUpUpload() {
  const form = byId("drop");
  if (!form) return;
  const [input, list, announce] = [byId("files"), byId("uploads"), byId("announce")];
  const start = async (files) => {
    const jobs = [...files].map((file) => uploadOne(file, byId("calibrate").checked, list));
    let done = 0;
    for (const job of jobs) {
      if (await job()) done += 1;
      window.htmx?.trigger("#photos", "refresh");
    }
    announce.textContent = `${done} of ${jobs.length} photos sent.`;
  };
  input.addEventListener("change", async () => {
    const files = [...input.files];
    input.value = "";
    await start(files);
  });
  form.addEventListener("submit", (event) => event.preventDefault());
  for (const kind of ["dragenter", "dragover"]) {
    form.addEventListener(kind, (event) => {
      event.preventDefault();
      form.classList.add("over");
    });
  }
  for (const kind of ["dragleave", "drop"]) form.addEventListener(kind, () => form.classList.remove("over"));
  form.addEventListener("drop", (event) => {
    event.preventDefault();
    start(event.dataTransfer.files);
  });
}

// --- forms that talk to the API -------------------------------------------------------------------

function setUpForm(id, act) {
  const form = byId(id);
  if (!form) return;
  const error = form.querySelector(".error");
  form.addEventListener("submit", async (event) => {
    event.preventDefault();
    error.hidden = true;
    const button = form.querySelector("button");
    button.disabled = true;
    try {
      await act(new FormData(form), form.dataset.photo);
    } catch (reason) {
      error.textContent = reason.message;
      error.hidden = false;
      button.disabled = false;
    }
  });
}

function setUpForms() {
  setUpForm("name-lens", async (fields, photo) => {
    const change = {};
    const label = fields.get("label").trim();
    if (label) change.new_lens = { label };
    else if (fields.get("lens_id")) change.lens_id = fields.get("lens_id");
    else throw new Error("Choose a lens, or give a new one a name.");
    const aperture = (fields.get("aperture") ?? "").replace(",", ".").trim();
    if (aperture) change.aperture = Number(aperture);
    if (Number.isNaN(change.aperture)) throw new Error(`The aperture must be a number such as 2.8, not "${aperture}".`);
    await send("PATCH", `/v1/photos/${photo}`, change);
    location.reload();
  });
  setUpForm("correct", async (fields, photo) => {
    const made = await send("POST", "/v1/corrections", {
      photo_id: photo,
      method: fields.get("method"),
      strength: Number(fields.get("strength")),
      output: { format: fields.get("format") },
    });
    location.assign(`/corrections/${made.id}`);
  });
}

// --- a page whose work has come to its end shows the result ------------------------------------------

function setUpSettling() {
  for (const id of ["photo-state", "correction-state"]) {
    const first = byId(id);
    if (!first || "settled" in first.dataset) continue;
    document.addEventListener("htmx:after:swap", () => {
      if ("settled" in (byId(id)?.dataset ?? {})) location.reload();
    });
  }
}

// --- the lens ------------------------------------------------------------------------------------

function setUpField() {
  const field = byId("field");
  if (!field) return;
  const controls = byId("field-controls");
  const [map, spot] = [field.querySelector("img"), field.querySelector(".spot")];
  const lens = `/v1/lenses/${field.dataset.lens}`;
  let [x, y] = [0.9, 0.15];
  const settings = () => {
    const chosen = new URLSearchParams(new FormData(controls));
    if (!chosen.get("aperture")) chosen.delete("aperture");
    return chosen;
  };
  const showPoint = async () => {
    spot.style.left = `${x * 100}%`;
    spot.style.top = `${y * 100}%`;
    // the frame of the map is taken as 3:2, as its grid of 9 x 6 equal cells is
    const [right, up] = [(x - 0.5) * 3, (0.5 - y) * 2];
    const [r, phi] = [Math.min(1, Math.hypot(right, up) / Math.hypot(1.5, 1)), Math.atan2(up, right)];
    const query = settings();
    query.set("r", r.toFixed(4));
    query.set("phi", phi.toFixed(4));
    query.set("size", "31");
    for (const kind of ["json", "npy", "tiff"]) byId(`psf-${kind}`).href = `${lens}/psf.${kind}?${query}`;
    byId("psf").src = `${lens}/psf.png?${query}`;
    const response = await fetch(`${lens}/psf.json?${query}`);
    if (!response.ok) {
      byId("psf-words").textContent = await problemText(response);
      return;
    }
    const { support } = await response.json();
    const error = support.predicted_error === null ? "" : `, expected error ${Math.round(support.predicted_error * 100)} %`;
    const beyond = support.extrapolated ? " Beyond what the photos cover: a guess." : "";
    byId("psf-words").textContent =
      `${Math.round(r * 100)} % of the way to the corner: seen in ${support.photos} photos, ` +
      `worth ${support.effective_samples.toFixed(1)} samples${error}.${beyond}`;
  };
  const showField = () => {
    map.src = `${lens}/field.png?grid=9x6&size=31&${settings()}&v=${field.dataset.version}`;
    showPoint();
  };
  field.addEventListener("click", (event) => {
    const box = field.getBoundingClientRect();
    [x, y] = [(event.clientX - box.left) / box.width, (event.clientY - box.top) / box.height];
    showPoint();
  });
  field.addEventListener("keydown", (event) => {
    const step = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[event.key];
    if (!step) return;
    event.preventDefault();
    [x, y] = [Math.min(1, Math.max(0, x + step[0] / 18)), Math.min(1, Math.max(0, y + step[1] / 12))];
    showPoint();
  });
  controls.addEventListener("change", showField);
  showField();
}

async function setUpHistory() {
  const holder = byId("history");
  if (!holder) return;
  const response = await fetch(`/v1/lenses/${holder.dataset.lens}/calibrations`);
  if (!response.ok) return;
  const events = (await response.json()).items;
  const zones = ["center", "mid", "corner"];
  const of = (event, zone) => (typeof event.error === "object" ? (event.error?.[zone] ?? null) : event.error);
  if (events.length < 2 || !events.some((event) => event.error !== null)) return;
  const ink = getComputedStyle(document.body).color;
  const axis = { stroke: ink, grid: { stroke: "#8884" } };
  new window.uPlot(
    {
      width: Math.min(holder.clientWidth, 720),
      height: 260,
      scales: { x: { time: false } },
      axes: [{ ...axis, label: "version" }, { ...axis, label: "held-out error" }],
      series: [{ label: "version" }, ...zones.map((zone, i) => ({ label: zone, stroke: ["#188038", "#f29900", "#d93025"][i], width: 2 }))],
    },
    [events.map((event) => event.version), ...zones.map((zone) => events.map((event) => of(event, zone)))],
    holder,
  );
}

function setUpRmap() {
  const [box, picture] = [byId("show-rmap"), byId("rmap")];
  box?.addEventListener("change", () => {
    if (box.checked && !picture.src) picture.src = picture.dataset.src;
    picture.hidden = !box.checked;
  });
}

// --- before and after -----------------------------------------------------------------------------

function setUpCompare() {
  const holder = byId("compare");
  if (!holder) return;
  const [before, after] = holder.querySelectorAll("img-comparison-slider img");
  const hold = byId("hold");
  const places = [...document.querySelectorAll(".places button")];
  const show = (button) => {
    for (const other of places) other.setAttribute("aria-pressed", String(other === button));
    const query = new URLSearchParams({ row: button.dataset.row, col: button.dataset.col, width: "640", height: "420" });
    before.src = `/ui/photos/${holder.dataset.photo}/crop.png?${query}`;
    hold.src = before.src;
    after.src = `/ui/corrections/${holder.dataset.id}/crop.png?${query}`;
  };
  for (const button of places) button.addEventListener("click", () => show(button));
  const holding = (event, on) => {
    if (event.key.toLowerCase() === "b" && !event.target.closest("input, textarea, select")) hold.hidden = !on;
  };
  document.addEventListener("keydown", (event) => holding(event, true));
  document.addEventListener("keyup", (event) => holding(event, false));
  if (places.length) show(places[0]);
}

setUpUpload();
setUpForms();
setUpSettling();
setUpField();
setUpHistory();
setUpRmap();
setUpCompare();
