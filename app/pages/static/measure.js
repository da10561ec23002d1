// A photo made to measure a lens is sent to that lens; of a pair, the closed photo goes first.

import { byId, problemText } from "./common.js";

async function post(url, file, fields) {
  const form = new FormData();
  for (const [name, value] of Object.entries(fields)) form.append(name, value);
  form.append("file", file, file.name);
  const response = await fetch(url, { method: "POST", body: form });
  if (!response.ok) throw new Error(await problemText(response));
  return response.json();
}

export function setUpMeasure() {
  const form = byId("measure");
  if (!form) return;
  const [kind, closed, words, error] = [
    form.elements.kind,
    byId("measure-closed"),
    byId("measure-words"),
    form.querySelector(".alert"),
  ];
  const button = form.querySelector("button");
  const show = () => {
    closed.hidden = kind.value !== "pair";
    form.elements.closed.required = kind.value === "pair";
    for (const hint of form.querySelectorAll("[data-kind]")) hint.hidden = hint.dataset.kind !== kind.value;
  };
  kind.addEventListener("change", show);
  show();
  button.disabled = false;
  form.addEventListener("submit", async (event) => {
    event.preventDefault();
    error.hidden = true;
    button.disabled = true;
    words.textContent = "Sending";
    try {
      const fields = { kind: kind.value };
      if (kind.value === "pair") {
        const reference = await post("/v1/photos", form.elements.closed.files[0], { calibrate: "false", lens_id: form.dataset.lens });
        fields.reference_id = reference.id;
      }
      const photo = await post(`/v1/lenses/${form.dataset.lens}/measurements`, form.elements.file.files[0], fields);
      location.assign(`/photos/${photo.id}`);
    } catch (reason) {
      words.textContent = "";
      error.textContent = reason.message;
      error.hidden = false;
      button.disabled = false;
    }
  });
}
