// Behaviour of the pages. Each part looks for its own element and does nothing where there is none.

import { setUpBatch } from "./batch.js";
import { setUpActions, setUpForms, setUpGroups, setUpSettling } from "./forms.js";
import { setUpCharts, setUpField, setUpHistory, setUpLensActions, setUpNewLens, setUpVersions } from "./lens.js";
import { setUpMeasure } from "./measure.js";
import { setUpPhoto } from "./photo.js";
import { setUpPreview } from "./preview.js";
import { setUpSignIn, setUpSignOut } from "./session.js";
import { setUpPolling } from "./poll.js";
import { setUpUpload } from "./upload.js";
import { setUpViewer } from "./view_tools.js";

const parts = [
  setUpUpload,
  setUpForms,
  setUpGroups,
  setUpActions,
  setUpBatch,
  setUpField,
  setUpCharts,
  setUpLensActions,
  setUpNewLens,
  setUpVersions,
  setUpHistory,
  setUpPhoto,
  setUpMeasure,
  setUpSignIn,
  setUpSignOut,
  () => setUpPreview(setUpViewer()),
  () => setUpPolling(setUpSettling()),
];
for (const setUp of parts) {
  try {
    setUp();
  } catch (reason) {
    console.error(reason); // one part that fails leaves the others working
  }
}
