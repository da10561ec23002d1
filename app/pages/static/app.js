// Behaviour of the pages. Each part looks for its own element and does nothing where there is none.

import { setUpBatch } from "./batch.js";
import { setUpForms, setUpGroups } from "./forms.js";
import { setUpCharts, setUpField, setUpLensActions } from "./lens.js";
import { keepPlace, setUpLive } from "./live.js";
import { setUpMeasure } from "./measure.js";
import { setUpPreview } from "./preview.js";
import { setUpSignIn, setUpSignOut } from "./session.js";
import { setUpUpload } from "./upload.js";
import { setUpViewer } from "./viewer.js";

const parts = [
  setUpUpload,
  setUpForms,
  setUpGroups,
  setUpBatch,
  setUpField,
  setUpCharts,
  setUpLensActions,
  setUpMeasure,
  setUpSignIn,
  setUpSignOut,
  () => setUpPreview(setUpViewer()),
  setUpLive,
  keepPlace,
];
for (const setUp of parts) {
  try {
    setUp();
  } catch (reason) {
    console.error(reason); // one part that fails leaves the others working
  }
}
