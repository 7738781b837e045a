"use strict";
// The arm in three dimensions: drag turns it, the slider and a click choose a configuration.
(() => {
  const source = document.getElementById("arm-data"), canvas = document.getElementById("arm");
  if (!source || !canvas) return;
  const scene = JSON.parse(source.textContent), items = scene.items;
  const slider = document.getElementById("arm-slider"), words = document.getElementById("arm-words");
  const ramp = JSON.parse(canvas.dataset.ramp);
  const tip = item => item.links[item.links.length - 1];
  const every = items.flatMap(item => item.links);
  const mean = [0, 1, 2].map(i => every.reduce((sum, p) => sum + p[i], 0) / every.length);
  const reach = Math.max(1e-3, ...every.map(p => Math.hypot(...p.map((v, i) => v - mean[i]))));
  let azimuth = 0.7, elevation = 0.35, chosen = 0, dots = [];

  const colour = value => value === null ? "#888888" :
    ramp[Math.max(0, Math.min(ramp.length - 1,
      Math.floor((value - scene.low) / (scene.high - scene.low || 1) * ramp.length)))];

  function draw() {
    const size = canvas.clientWidth || 320, ratio = window.devicePixelRatio || 1;
    canvas.width = canvas.height = size * ratio;
    const c = canvas.getContext("2d");
    c.setTransform(ratio, 0, 0, ratio, 0, 0);
    const style = getComputedStyle(canvas), ink = style.color, scale = 0.46 * size / reach;
    const ca = Math.cos(azimuth), sa = Math.sin(azimuth), ce = Math.cos(elevation), se = Math.sin(elevation);
    const at = p => {
      const [x, y, z] = p.map((v, i) => v - mean[i]);
      const across = -sa * x + ca * y, depth = ca * x + sa * y;
      return [size / 2 + scale * across, size / 2 - scale * (ce * z - se * depth), ce * depth + se * z];
    };
    const line = (points, width, stroke) => {
      c.beginPath();
      points.map(at).forEach(([x, y], i) => i ? c.lineTo(x, y) : c.moveTo(x, y));
      c.lineWidth = width; c.strokeStyle = stroke; c.lineCap = c.lineJoin = "round"; c.stroke();
    };
    const base = items[chosen].links[0], axis = 0.25 * reach;
    [["#D55E00", 0, "x"], ["#009E73", 1, "y"], ["#0072B2", 2, "z"]].forEach(([stroke, i, name]) => {
      const end = base.map((v, k) => v + (k === i ? axis : 0));
      line([base, end], 2, stroke);
      const [x, y] = at(base.map((v, k) => v + (k === i ? 1.2 * axis : 0)));
      c.fillStyle = ink; c.font = "12px sans-serif"; c.textAlign = "center"; c.textBaseline = "middle";
      c.fillText(name, x, y);
    });
    dots = items.map((item, i) => [...at(tip(item)), i]).sort((a, b) => a[2] - b[2]);
    for (const [x, y, , i] of dots) {
      c.beginPath();
      if (items[i].test) c.rect(x - 3, y - 3, 6, 6); else c.arc(x, y, 3.5, 0, 7);
      c.fillStyle = colour(items[i].value); c.fill();
      c.lineWidth = 0.8; c.strokeStyle = ink; c.stroke();  // seen on a panel of any colour
    }
    line(items[chosen].links, 4, ink);
    c.fillStyle = ink;
    for (const p of items[chosen].links) { const [x, y] = at(p); c.beginPath(); c.arc(x, y, 4, 0, 7); c.fill(); }
    const [x, y] = at(tip(items[chosen]));
    c.beginPath(); c.arc(x, y, 8, 0, 7); c.lineWidth = 2; c.strokeStyle = ink; c.stroke();
  }

  function choose(i) {
    chosen = Math.max(0, Math.min(items.length - 1, i));
    slider.value = chosen;
    const item = items[chosen], value = item.value === null ? "no residual" : `${item.value} ${scene.unit}`;
    words.textContent = `configuration ${item.id} (${item.test ? "test" : "train"}): ${scene.family} residual ${value}`;
    draw();
  }

  let from = null, moved = 0;
  canvas.addEventListener("pointerdown", event => {
    from = [event.clientX, event.clientY]; moved = 0; canvas.setPointerCapture(event.pointerId);
  });
  canvas.addEventListener("pointermove", event => {
    if (!from) return;
    const dx = event.clientX - from[0], dy = event.clientY - from[1];
    moved += Math.abs(dx) + Math.abs(dy); from = [event.clientX, event.clientY];
    azimuth -= 0.01 * dx; elevation = Math.max(-1.5, Math.min(1.5, elevation + 0.01 * dy)); draw();
  });
  canvas.addEventListener("pointerup", event => {
    from = null;
    if (moved > 4) return;
    const box = canvas.getBoundingClientRect(), x = event.clientX - box.left, y = event.clientY - box.top;
    const near = dots.map(d => [Math.hypot(d[0] - x, d[1] - y), d[3]]).sort((a, b) => a[0] - b[0])[0];
    if (near && near[0] < 20) choose(near[1]);
  });
  canvas.addEventListener("keydown", event => {
    const turn = {ArrowLeft: [0.1, 0], ArrowRight: [-0.1, 0], ArrowUp: [0, 0.1], ArrowDown: [0, -0.1]}[event.key];
    if (!turn) return;
    event.preventDefault(); azimuth += turn[0]; elevation = Math.max(-1.5, Math.min(1.5, elevation + turn[1])); draw();
  });
  slider.max = items.length - 1;
  slider.addEventListener("input", () => choose(Number(slider.value)));
  for (const query of ["(prefers-color-scheme: dark)", "print"])
    window.matchMedia(query).addEventListener("change", draw);
  window.addEventListener("resize", draw);
  const worst = items.reduce((best, item, i) => (item.value ?? -1) > (items[best].value ?? -1) ? i : best, 0);
  choose(worst);
})();
