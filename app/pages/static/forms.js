// Forms and buttons that talk to the API, and pages that wait for work to end.

import { byId, problemText, send } from "./common.js";

function setUpForm(id, act) {
  const form = byId(id);
  if (!form) return;
  const error = form.querySelector(".alert");
  form.querySelector("button").disabled = false; // until now a click would have gone nowhere
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

export function setUpForms() {
  setUpForm("name-lens", async (fields, photo) => {
    const change = {};
    const known = !fields.has("label"); // the lens: only its aperture is asked for
    const label = fields.get("label")?.trim();
    if (label) change.new_lens = { label };
    else if (fields.get("lens_id")) change.lens_id = fields.get("lens_id");
    else if (!known) throw new Error("Choose a lens, or give a new one a name.");
    const aperture = (fields.get("aperture") ?? "").replace(",", ".").trim();
    if (aperture) change.aperture = Number(aperture);
    else if (known) throw new Error("Give the aperture, a number such as 2.8.");
    if (Number.isNaN(change.aperture)) throw new Error(`The aperture must be a number such as 2.8, not "${aperture}".`);
    await send("PATCH", `/v1/photos/${photo}`, change);
    location.reload();
  });
  setUpForm("correct", async (fields, photo) => {
    const wish = {
      photo_id: photo,
      method: fields.get("method"),
      strength: Number(fields.get("strength")),
      output: { format: fields.get("format") },
    };
    if (fields.get("lens_id")) wish.lens_id = fields.get("lens_id");
    const made = await send("POST", "/v1/corrections", wish);
    location.assign(`/corrections/${made.id}`);
  });
  const strength = document.querySelector("#correct [name=strength]");
  strength?.addEventListener("input", () => {
    byId("strength-words").textContent = strength.value === "1" ? "full" : `${Math.round(strength.value * 100)} %`;
  });
}

export function setUpActions() {
  const holder = byId("photo-actions");
  if (!holder) return;
  const photo = holder.dataset.photo;
  const error = holder.querySelector(".alert");
  const acts = {
    cancel: () => send("POST", `/v1/jobs/${photo}/cancel`),
    exclude: () => send("PATCH", `/v1/photos/${photo}`, { excluded: true }),
    include: () => send("PATCH", `/v1/photos/${photo}`, { excluded: false }),
    delete: async () => {
      if (!window.confirm("Delete this photo, its corrections, and what the lens learned from it?")) return;
      const response = await fetch(`/v1/photos/${photo}`, { method: "DELETE" });
      if (!response.ok) throw new Error(await problemText(response));
      location.assign("/");
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

// A page whose work has come to its end shows the result.
export function setUpSettling() {
  for (const id of ["photo-state", "correction-state", "lens-state"]) {
    const first = byId(id);
    if (!first || "settled" in first.dataset) continue;
    document.addEventListener("htmx:after:swap", () => {
      if ("settled" in (byId(id)?.dataset ?? {})) location.reload();
    });
  }
}
