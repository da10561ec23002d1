// Forms and buttons that talk to the API, and pages that wait for work to end.

import { byId, confirmed, send, withItsLens } from "./common.js";
import { refreshed, removing } from "./poll.js";

function setUpForm(id, act) {
  const form = byId(id);
  if (!form?.querySelector("button")) return; // a photo without any lens has nothing to send
  const error = form.querySelector(".alert");
  const button = form.querySelector("button");
  button.disabled = false; // until now a click would have gone nowhere
  form.addEventListener("submit", async (event) => {
    event.preventDefault();
    error.hidden = true;
    button.disabled = true;
    try {
      button.disabled = (await act(new FormData(form), form.dataset.photo)) !== false;
    } catch (reason) {
      error.textContent = reason.message;
      error.hidden = false;
      button.disabled = false;
    }
  });
}

export function setUpForms() {
  setUpForm("name-lens", async (fields, photo) => {
    const known = !fields.has("label"); // the lens: only its aperture is asked for
    const change = { ...namedLens(fields), ...givenAperture(fields) };
    if (known && !change.aperture) throw new Error("Give the aperture, a number such as 2.8.");
    if (!known && !change.lens_id && !change.new_lens) throw new Error("Choose a lens, or give a new one a name.");
    await send("PATCH", `/v1/photos/${photo}`, change);
    location.reload();
  });
  setUpForm("correct", async (fields, photo) => {
    const wish = {
      photo_id: photo,
      method: fields.get("method"),
      strength: Number(fields.get("strength")),
      texture: Number(fields.get("texture")),
      denoise: Number(fields.get("denoise")),
      output: { format: fields.get("format") },
    };
    if (fields.get("lens_id")) wish.lens_id = fields.get("lens_id");
    const made = await withItsLens((any) => send("POST", "/v1/corrections", any ? { ...wish, any_lens: true } : wish));
    if (made) location.assign(`/corrections/${made.id}`);
    return Boolean(made);
  });
  for (const output of document.querySelectorAll("#correct output")) {
    const slider = byId("correct").elements[output.dataset.for];
    const say = () => {
      output.textContent = `${Math.round(slider.value * 100)} %`;
      slider.setAttribute("aria-valuetext", output.textContent);
    };
    slider.addEventListener("input", say);
    say();
  }
  const stop = byId("stop-correction");
  if (stop) {
    stop.disabled = false;
    stop.addEventListener("click", async () => {
      stop.disabled = true;
      await send("POST", `/v1/jobs/${stop.dataset.id}/cancel`).catch(() => {}); // it may be done already
    });
  }
}

export function setUpActions() {
  const holder = byId("photo-actions");
  if (!holder) return;
  const photo = holder.dataset.photo;
  const error = holder.querySelector(".alert");
  const acts = {
    cancel: () => send("POST", `/v1/jobs/${photo}/cancel`),
    retry: () => send("POST", `/v1/jobs/${photo}/retry`),
    exclude: () => send("PATCH", `/v1/photos/${photo}`, { excluded: true }),
    learn: () => send("PATCH", `/v1/photos/${photo}`, { calibrate: true }),
    include: () => send("PATCH", `/v1/photos/${photo}`, { excluded: false }),
    delete: async () => {
      const question = "Delete this photo, its corrections, and what was learned from it?";
      if (await confirmed(question, "Delete the photo")) await removing("/", () => send("DELETE", `/v1/photos/${photo}`));
    },
  };
  for (const button of holder.querySelectorAll("button")) {
    button.disabled = false;
    button.addEventListener("click", async () => {
      error.hidden = true;
      try {
        await acts[button.dataset.act]();
        if (button.dataset.act !== "delete") location.reload();
      } catch (reason) {
        error.textContent = reason.message;
        error.hidden = false;
      }
    });
  }
}

// Whether somebody is asked, types, or waits for what a form does: then nothing may take the page away.
const occupied = () =>
  document.querySelector("dialog[open], form[aria-busy=true]") || document.activeElement?.matches("input:not([type=checkbox]), select");

function reloadWhenFree() {
  if (occupied()) setTimeout(reloadWhenFree, 1000);
  else location.reload();
}

// A page whose work has come to its end shows the result.
export function setUpSettling() {
  const open = [...document.querySelectorAll("[id$='-state']")].filter((part) => !part.querySelector("[data-settled]"));
  return (name) => {
    const part = byId(name);
    if (!open.includes(part) || !part.querySelector("[data-settled]")) return;
    open.splice(open.indexOf(part), 1);
    reloadWhenFree();
  };
}

// Photos that do not say their lens, group by group. The form is made anew at any moment, so that listeners stand
// above it, and while answers are to come it takes no second wish.
export function setUpGroups() {
  const holder = byId("waiting");
  if (!holder) return;
  let underWay = false;
  const attempt = async (act) => {
    if (underWay) return;
    underWay = true;
    await act().catch((reason) => complain(byId("waiting-form"), reason));
    underWay = false;
    await refreshed();
    if (!holder.contains(document.activeElement)) (holder.querySelector("[data-leave]") ?? byId("photos-title")).focus();
  };
  holder.addEventListener("submit", (event) => {
    event.preventDefault();
    attempt(async () => {
      const groups = [...event.target.querySelectorAll("fieldset")].filter((group) => group.querySelector(":checked[name=photo]"));
      if (!groups.length) throw new Error("Tick the photos to use.");
      let count = 0;
      for (const group of groups) count += await learned(group).catch((reason) => complain(group, reason));
      if (count) byId("announce").textContent = count === 1 ? "1 photo is being processed." : `${count} photos are being processed.`;
    });
  });
  holder.addEventListener("click", (event) => {
    if (!event.target.matches("[data-leave]")) return;
    const photos = [...event.target.closest("fieldset").querySelectorAll("[name=photo]")];
    attempt(() => Promise.all(photos.map(({ value }) => send("POST", `/v1/jobs/${value}/cancel`))));
  });
}

// Send what is said of a group; how many photos it has.
async function learned(group) {
  group.querySelector(".alert").hidden = true;
  const fields = new FormData();
  for (const { name, value, type, checked } of group.querySelectorAll("[name]")) if (type !== "checkbox" || checked) fields.append(name, value);
  const change = { photo_ids: fields.getAll("photo"), ...namedLens(fields), ...givenAperture(fields) };
  if (fields.has("aperture") && !change.aperture) throw new Error("Give the aperture, a number such as 2.8.");
  if (!change.lens_id && !change.new_lens) throw new Error("Choose a lens, or give a new one a name.");
  await send("PATCH", "/v1/photos", change);
  return change.photo_ids.length;
}

function complain(part, reason) {
  const alert = part.querySelector(":scope > .alert");
  alert.textContent = reason.message;
  alert.hidden = false;
  return 0;
}

function namedLens(fields) {
  const label = fields.get("label")?.trim();
  if (fields.get("lens_id")) return { lens_id: fields.get("lens_id") };
  return label ? { new_lens: { label } } : {};
}

function givenAperture(fields) {
  const text = (fields.get("aperture") ?? "").replace(",", ".").replace(/^f\/?/i, "").trim();
  if (!text) return {};
  const aperture = Number(text);
  if (Number.isNaN(aperture)) throw new Error(`The aperture must be a number such as 2.8, not "${text}".`);
  if (aperture < 0.5 || aperture > 128) throw new Error("Give an f-number between 0.5 and 128, for example 2.8.");
  return { aperture };
}
