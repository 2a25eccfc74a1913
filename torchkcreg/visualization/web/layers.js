// Measured views and the same with the implant: one over the other, blinked, as a checkerboard, or wiped. The chosen
// view comes first, and as many after it as fit side by side.
for (const box of document.querySelectorAll(".layers")) {
  const canvas = box.querySelector("canvas"), pen = canvas.getContext("2d"), images = [...box.querySelectorAll("img")];
  const field = name => box.querySelector(`[name=${name}]`);
  let shown = true;

  function draw() {
    const view = field("view").selectedIndex, mode = field("mode").value, place = Number(field("place").value) / 100;
    const first = images[2 * view];
    if (!first.naturalWidth) return;
    const ratio = window.devicePixelRatio || 1, most = Math.min(canvas.parentElement.clientWidth - 32, 900);
    const scale = Math.min(most / first.naturalWidth, Math.min(720, Math.max(320, 0.7 * window.innerHeight)) / first.naturalHeight);
    const width = Math.round(first.naturalWidth * scale), height = Math.round(first.naturalHeight * scale), gap = 8;
    const count = Math.max(1, Math.min(images.length / 2, Math.floor((most + gap) / (width + gap))));
    const whole = count * (width + gap) - gap;
    canvas.style.width = whole + "px"; canvas.style.height = height + "px";
    canvas.width = whole * ratio; canvas.height = height * ratio;
    for (let k = 0; k < count; k++) {
      const at = (view + k) % (images.length / 2);
      pen.setTransform(ratio, 0, 0, ratio, k * (width + gap) * ratio, 0);
      compare(images[2 * at], images[2 * at + 1], width, height, mode, place);
    }
  }

  function compare(under, over, width, height, mode, place) {
    if (!under.naturalWidth || !over.naturalWidth) return;
    pen.drawImage(mode === "overlay" || (mode === "blink" && shown) ? over : under, 0, 0, width, height);
    if (mode !== "checkerboard" && mode !== "wipe") return;
    pen.save(); pen.beginPath();
    if (mode === "wipe") pen.rect(0, 0, place * width, height);
    else {
      const side = 8 + place * Math.max(width, height) / 4;
      for (let j = 0; j * side < height; j++) for (let i = j % 2; i * side < width; i += 2) pen.rect(i * side, j * side, side, side);
    }
    pen.clip(); pen.drawImage(over, 0, 0, width, height); pen.restore();
  }
  setInterval(() => { if (field("mode").value === "blink") { shown = !shown; draw(); } }, 500);
  for (const control of box.querySelectorAll("input, select")) control.addEventListener("input", draw);
  for (const image of images) image.addEventListener("load", draw);
  window.addEventListener("resize", draw);
  draw();
}
