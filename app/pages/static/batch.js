// Photos that are chosen in a list and corrected together.

import { acting, byId, send } from "./common.js";

export function setUpBatch() {
  const form = byId("batch");
  if (!form) return;
  const [every, go] = [form.querySelector("[data-every]"), form.querySelector("button:not([data-every])")];
  const boxes = () => [...form.querySelectorAll("[name=photo]")];
  const chosen = () => boxes().filter(({ checked }) => checked);
  const show = () => {
    const count = chosen().length;
    every.hidden = boxes().length < 2;
    every.textContent = count < boxes().length ? "Choose all" : "Choose none";
    go.hidden = count === 0;
    go.textContent = count === 1 ? "Correct 1 photo" : `Correct ${count} photos`;
  };
  form.addEventListener("change", show);
  document.addEventListener("htmx:after:swap", show); // the list grows
  every.addEventListener("click", () => {
    const all = every.textContent === "Choose all";
    for (const box of boxes()) box.checked = all;
    show();
  });
  acting(form, async () => {
    const [made, refused] = [[], []];
    for (const { value, ariaLabel } of chosen()) {
      const name = ariaLabel.replace("Choose ", "");
      await send("POST", "/v1/corrections", { photo_id: value, output: { format: /\.jpe?g$/i.test(name) ? "jpeg" : "tiff16" } }).then(
        ({ id }) => made.push(id),
        (reason) => refused.push(`${name}: ${reason.message}`),
      );
    }
    const address = `/batch?ids=${made.join(",")}`;
    if (!refused.length) return address;
    if (!made.length) throw new Error(refused.join(" "));
    const link = Object.assign(document.createElement("a"), { href: address, textContent: "The others are being corrected." });
    const alert = form.querySelector(".alert");
    alert.replaceChildren(`${refused.join(" ")} `, link);
    alert.hidden = false;
    return "";
  });
  show();
}
