// Tiles of a picture, fetched as they are looked at; the least recently used are let go.

export const TILE = 512;
const MOST = 160; // some 120 MB of pixels: two screens of 4K before and after

export class Tiles {
  constructor(base, width, height, onLoad) {
    Object.assign(this, { base, width, height, onLoad });
    this.kept = new Map();
    this.failed = false;
    this.loading = false; // whether something of what was drawn last is on its way
    this.levels = Math.max(0, Math.ceil(Math.log2(Math.max(width, height) / TILE)));
    this.whole = new Image();
    this.whole.addEventListener("load", onLoad);
    this.whole.addEventListener("error", () => {
      this.failed = true;
      onLoad();
    });
    this.whole.src = `${base}/whole.jpg`;
  }

  // Level 0 is the photo pixel by pixel, each next one half as large; `pixel` is device pixels per photo pixel.
  level(pixel) {
    return Math.min(this.levels, Math.max(0, Math.floor(Math.log2(1 / pixel) + 0.01)));
  }

  get(level, col, row) {
    const key = `${level}/${col}_${row}`;
    let tile = this.kept.get(key);
    this.kept.delete(key);
    if (!tile) {
      tile = new Image();
      tile.decoding = "async";
      tile.addEventListener("load", this.onLoad);
      tile.addEventListener("error", this.onLoad);
      tile.src = `${this.base}/${key}.jpg`;
    }
    this.kept.set(key, tile);
    while (this.kept.size > MOST) this.kept.delete(this.kept.keys().next().value);
    this.loading ||= !tile.complete;
    return tile.complete && tile.naturalWidth ? tile : null;
  }

  // Draw the part of the picture that a pane shows; `toPane` maps photo pixels to the canvas.
  draw(context, view, pane, ratio) {
    const { scale } = view;
    this.loading ||= !this.whole.complete;
    const left = pane.x + pane.width / 2 - view.x * scale;
    const top = pane.y + pane.height / 2 - view.y * scale;
    context.imageSmoothingEnabled = scale * ratio < 0.999;
    if (this.whole.naturalWidth) context.drawImage(this.whole, left, top, this.width * scale, this.height * scale);
    if (this.whole.naturalWidth >= this.width * scale * ratio) return; // as sharp as the screen already
    const level = this.level(scale * ratio);
    const side = TILE * 2 ** level;
    const first = (from, edge) => Math.max(0, Math.floor((edge - from) / scale / side));
    const last = (from, edge, size) => Math.min(Math.ceil(size / side) - 1, Math.floor((edge - from) / scale / side));
    for (let row = first(top, pane.y); row <= last(top, pane.y + pane.height, this.height); row += 1) {
      for (let col = first(left, pane.x); col <= last(left, pane.x + pane.width, this.width); col += 1) {
        const tile = this.get(level, col, row);
        if (!tile) continue;
        const [wide, high] = [
          Math.min(side, this.width - col * side),
          Math.min(side, this.height - row * side),
        ];
        context.drawImage(tile, left + col * side * scale, top + row * side * scale, wide * scale, high * scale);
      }
    }
  }
}
