// Behaviour of the pages. Each part looks for its own element and does nothing where there is none.

import { setUpCompare } from "./compare.js";
import { setUpActions, setUpForms, setUpSettling } from "./forms.js";
import { setUpField, setUpHistory } from "./lens.js";
import { setUpPhoto } from "./photo.js";
import { setUpUpload } from "./upload.js";

setUpUpload();
setUpForms();
setUpActions();
setUpSettling();
setUpField();
setUpHistory();
setUpPhoto();
setUpCompare();
