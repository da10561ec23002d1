// Forms that talk to the API.

import { acting, byId, confirmed, send, withItsLens } from "./common.js";
import { refresh } from "./live.js";

export function setUpForms() {
  acting(byId("name-lens"), async (fields, { dataset }) => {
    const known = !fields.has("label"); // the lens: only its aperture is asked for
    const change = { ...namedLens(fields), ...givenAperture(fields) };
    if (known && !change.aperture) throw new Error("Give the aperture, a number such as 2.8.");
    if (!known && !change.lens_id && !change.new_lens) throw new Error("Choose a lens, or give a new one a name.");
    await send("PATCH", `/v1/photos/${dataset.photo}`, change);
    return true;
  });
  const form = byId("correct");
  acting(form, async (fields, { dataset }) => {
    const wish = { photo_id: dataset.photo, method: fields.get("method"), output: { format: fields.get("format") } };
    for (const name of ["strength", "texture", "denoise"]) wish[name] = Number(fields.get(name));
    if (fields.get("lens_id")) wish.lens_id = fields.get("lens_id");
    const made = await withItsLens((any) => send("POST", "/v1/corrections", any ? { ...wish, any_lens: true } : wish));
    return made && `/corrections/${made.id}`;
  });
  for (const output of form?.querySelectorAll("output") ?? []) {
    const slider = form.elements[output.dataset.for];
    const say = () => {
      output.textContent = `${Math.round(slider.value * 100)} %`;
      slider.setAttribute("aria-valuetext", output.textContent);
    };
    slider.addEventListener("input", say);
    say();
  }
  acting(byId("stop-correction"), async (_, { dataset }) => {
    await send("POST", `/v1/jobs/${dataset.id}/cancel`).catch(() => {}); // it may be done already
    return true;
  });
  acting(byId("photo-actions"), async (_, { dataset }, button) => {
    const [photo, job] = [`/v1/photos/${dataset.photo}`, `/v1/jobs/${dataset.photo}`];
    const acts = {
      cancel: () => send("POST", `${job}/cancel`),
      retry: () => send("POST", `${job}/retry`),
      learn: () => send("PATCH", photo, { calibrate: true }),
      exclude: () => send("PATCH", photo, { excluded: true }),
      include: () => send("PATCH", photo, { excluded: false }),
    };
    if (acts[button.value]) return acts[button.value]().then(() => true);
    const question = "Delete this photo, its corrections, and what was learned from it?";
    return (await confirmed(question, "Delete the photo")) && send("DELETE", photo).then(() => "/");
  });
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
    refresh();
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
  for (const fold of part.querySelectorAll(":scope > .controls > details")) fold.open = true; // what is missing may be in it
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
