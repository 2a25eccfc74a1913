"use strict";
// Points of the implant with their displacement, focal spots and detectors: drag turns, wheel or pinch zooms.
for (const box of document.querySelectorAll(".viewer")) {
  const scene = JSON.parse(box.querySelector("script[type='application/json']").textContent);
  const canvas = box.querySelector("canvas"), pen = canvas.getContext("2d");
  const field = name => box.querySelector(`[name=${name}]`);
  const n = scene.points.length / 3;
  const ramp = [[68, 1, 84], [59, 82, 139], [33, 145, 140], [94, 201, 98], [253, 231, 37]]; // viridis
  const colour = t => {
    const x = Math.min(0.9999, Math.max(0, t)) * (ramp.length - 1), i = Math.floor(x), f = x - i;
    return "rgb(" + ramp[i].map((a, k) => Math.round(a + f * (ramp[i + 1][k] - a))).join(",") + ")";
  };
  let yaw = scene.yaw ?? 0.6, pitch = -0.35, zoom = 1, pointers = new Map(), gap = 0;
  const center = [0, 1, 2].map(k => { let s = 0; for (let i = 0; i < n; i++) s += scene.points[3 * i + k]; return s / n; });
  let reach = 1;
  for (let i = 0; i < n; i++) reach = Math.max(reach, Math.hypot(...[0, 1, 2].map(k => scene.points[3 * i + k] - center[k])));

  function draw() {
    const width = canvas.clientWidth, height = canvas.clientHeight, ratio = window.devicePixelRatio || 1;
    canvas.width = width * ratio; canvas.height = height * ratio;
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.clearRect(0, 0, width, height);
    const views = field("views") && field("views").checked && scene.sources.length;
    const far = views ? 1.2 * Math.max(reach, ...scene.sources.map(s => Math.hypot(...s.map((x, k) => x - center[k])))) : reach;
    const scale = zoom * 0.45 * Math.min(width, height) / far;
    const [cy, sy, cp, sp] = [Math.cos(yaw), Math.sin(yaw), Math.cos(pitch), Math.sin(pitch)];
    const place = p => {
      const [x, y, z] = p.map((v, k) => v - center[k]);
      const a = cy * x - sy * y, b = sy * x + cy * y;
      return [width / 2 + scale * a, height / 2 - scale * (cp * z + sp * b), cp * b - sp * z];
    };
    if (views) {
      pen.strokeStyle = "rgba(140,170,210,0.55)"; pen.fillStyle = "#e69f00"; pen.lineWidth = 1;
      scene.sources.forEach((source, v) => {
        const [x, y] = place(source), corners = scene.detectors[v].map(place);
        pen.beginPath(); corners.forEach(([a, b], k) => k ? pen.lineTo(a, b) : pen.moveTo(a, b)); pen.closePath(); pen.stroke();
        pen.beginPath(); for (const [a, b] of corners) { pen.moveTo(x, y); pen.lineTo(a, b); }
        pen.globalAlpha = 0.35; pen.stroke(); pen.globalAlpha = 1;
        pen.beginPath(); pen.arc(x, y, 4, 0, 7); pen.fill();
      });
    }
    const times = Number(field("times").value), values = scene[field("value").value];
    const top = Math.max(1e-9, ...values);
    box.querySelector("output").textContent = times + " x";
    const at = (p, moved, i) => [0, 1, 2].map(k => p[3 * i + k] + (times - 1) * moved[3 * i + k]);
    const drawn = [];
    for (let i = 0; i < n; i++) {
      drawn.push([...place(at(scene.points, scene.moved, i)), i]);
    }
    drawn.sort((a, b) => b[2] - a[2]);
    const size = Math.max(1.5, scale * scene.pitch);
    if (scene.ghost) { // the undeformed implant, in grey
      pen.fillStyle = "rgba(150,160,175,0.25)";
      for (let i = 0; i < n; i++) {
        const [x, y] = place([0, 1, 2].map(k => scene.points[3 * i + k] - scene.moved[3 * i + k]));
        pen.fillRect(x - size / 2, y - size / 2, size, size);
      }
    }
    if (scene.lines) { // ends of the screws
      pen.strokeStyle = "rgba(230,159,0,0.9)"; pen.lineWidth = Math.max(2, 2.5 * scale);
      for (let i = 0; i + 1 < scene.lines.length / 3; i += 2) {
        const [a, b] = [i, i + 1].map(j => place(at(scene.lines, scene.linesMoved, j)));
        pen.beginPath(); pen.moveTo(a[0], a[1]); pen.lineTo(b[0], b[1]); pen.stroke();
      }
    }
    for (const [x, y, , i] of drawn) { pen.fillStyle = colour(values[i] / top); pen.fillRect(x - size / 2, y - size / 2, size, size); }
    const bar = Math.min(160, width / 3);
    for (let i = 0; i < bar; i++) { pen.fillStyle = colour(i / bar); pen.fillRect(12 + i, height - 22, 1.5, 8); }
    pen.fillStyle = "#dfe6ee"; pen.font = "12px system-ui, sans-serif";
    const nice = [1, 2, 5, 10, 20, 50, 100].filter(mm => mm * scale < width / 4).pop() || 1;
    pen.fillRect(width - 12 - nice * scale, height - 18, nice * scale, 2);
    pen.fillText(nice + " mm", width - 12 - nice * scale, height - 26);
    pen.fillText("0", 12, height - 26); pen.fillText(top.toPrecision(3) + " mm", 12 + bar - 40, height - 26);
  }
  canvas.addEventListener("pointerdown", e => { pointers.set(e.pointerId, [e.clientX, e.clientY]); canvas.setPointerCapture(e.pointerId); });
  canvas.addEventListener("pointermove", e => {
    const last = pointers.get(e.pointerId);
    if (!last) return;
    pointers.set(e.pointerId, [e.clientX, e.clientY]);
    if (pointers.size === 1) { yaw += (e.clientX - last[0]) / 120; pitch += (e.clientY - last[1]) / 120; }
    else {
      const [a, b] = [...pointers.values()], now = Math.hypot(a[0] - b[0], a[1] - b[1]);
      if (gap) zoom *= now / gap;
      gap = now;
    }
    draw();
  });
  for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, e => { pointers.delete(e.pointerId); gap = 0; });
  canvas.addEventListener("wheel", e => { e.preventDefault(); zoom *= Math.exp(-e.deltaY / 600); draw(); }, { passive: false });
  for (const control of box.querySelectorAll("input, select")) control.addEventListener("input", draw);
  window.addEventListener("resize", draw);
  draw();
}
