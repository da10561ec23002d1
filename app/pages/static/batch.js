// Photos that are chosen in a list and corrected together.

import { byId, send } from "./common.js";

export function setUpBatch() {
  const form = byId("batch");
  if (!form) return;
  const [every, go, alert] = [form.querySelector("[data-every]"), form.querySelector("button:not([data-every])"), form.querySelector(".alert")];
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
  if (byId("photos")) new MutationObserver(show).observe(byId("photos"), { childList: true, subtree: true }); // it grows
  every.addEventListener("click", () => {
    const all = every.textContent === "Choose all";
    for (const box of boxes()) box.checked = all;
    show();
  });
  form.addEventListener("submit", async (event) => {
    event.preventDefault();
    go.disabled = true;
    const [made, refused] = [[], []];
    for (const { value, ariaLabel } of chosen()) {
      const name = ariaLabel.replace("Choose ", "");
      await send("POST", "/v1/corrections", { photo_id: value, output: { format: /\.jpe?g$/i.test(name) ? "jpeg" : "tiff16" } }).then(
        ({ id }) => made.push(id),
        (reason) => refused.push(`${name}: ${reason.message}`),
      );
    }
    go.disabled = false;
    alert.textContent = refused.join(" ");
    alert.hidden = !refused.length;
    if (made.length && !refused.length) location.assign(`/batch?ids=${made.join(",")}`);
    else if (made.length) {
      const link = document.createElement("a");
      link.href = `/batch?ids=${made.join(",")}`;
      link.textContent = " The others are being corrected.";
      alert.append(link);
    }
  });
  show();
}
