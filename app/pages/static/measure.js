// A photo made to measure a lens is sent to that lens; of a pair, the closed photo goes first.

import { acting, ask, byId } from "./common.js";

async function post(url, file, fields) {
  const form = new FormData();
  for (const [name, value] of Object.entries(fields)) form.append(name, value);
  form.append("file", file, file.name);
  return (await ask(url, { method: "POST", body: form })).json();
}

export function setUpMeasure() {
  const form = byId("measure");
  if (!form) return;
  const { kind, closed, file } = form.elements;
  const show = () => {
    byId("measure-closed").hidden = kind.value !== "pair";
    closed.required = kind.value === "pair";
    for (const hint of form.querySelectorAll("[data-kind]")) hint.hidden = hint.dataset.kind !== kind.value;
  };
  kind.addEventListener("change", show);
  show();
  acting(form, async () => {
    const words = byId("measure-words");
    words.textContent = "Sending";
    try {
      const fields = { kind: kind.value };
      if (kind.value === "pair") fields.reference_id = (await post("/v1/photos", closed.files[0], { calibrate: "false", lens_id: form.dataset.lens })).id;
      return `/photos/${(await post(`/v1/lenses/${form.dataset.lens}/measurements`, file.files[0], fields)).id}`;
    } finally {
      words.textContent = "";
    }
  });
}
