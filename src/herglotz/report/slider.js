// A walk through the free run: the slider moves a cursor over data and model, and its output says both values there.
const short = (x, digits) => String(Number(x.toPrecision(digits)));  // 9.95, not 9.950
for (const figure of document.querySelectorAll(".slider")) {
  const v = JSON.parse(figure.querySelector("script").textContent);
  const canvas = figure.querySelector("canvas"), g = canvas.getContext("2d");
  const input = figure.querySelector("input"), output = figure.querySelector("output");
  const ratio = window.devicePixelRatio || 1, width = canvas.clientWidth || 900, height = Math.max(200, 0.36 * width);
  canvas.width = ratio * width; canvas.height = ratio * height; g.scale(ratio, ratio);  // text keeps its size on a phone
  canvas.style.height = `${height}px`;
  const n = v.t.length, right = 10, top = 12, bottom = 32, font = "13px system-ui, sans-serif";
  input.max = n - 1;
  const known = v.data.concat(v.model.filter((x) => x !== null));
  const low = known.reduce((a, b) => Math.min(a, b)), high = known.reduce((a, b) => Math.max(a, b)), span = high - low || 1;
  g.font = font;
  const left = 14 + Math.max(...[low, high].map((q) => g.measureText(short(q, 3)).width));  // -1.23e+30 is wide
  const x = (t) => left + ((t - v.t[0]) / (v.t[n - 1] - v.t[0] || 1)) * (width - left - right);
  const y = (q) => top + ((high + 0.05 * span - q) / (1.1 * span)) * (height - top - bottom);
  const line = (from, to, colour) => {
    g.strokeStyle = colour; g.lineWidth = 2; g.beginPath();
    for (let k = from, pen = false; k <= to; k++) {
      if (v.model[k] === null) { pen = false; continue; }
      if (pen) g.lineTo(x(v.t[k]), y(v.model[k])); else g.moveTo(x(v.t[k]), y(v.model[k]));
      pen = true;
    }
    g.stroke();
  };
  const draw = () => {
    const k = Number(input.value);
    g.clearRect(0, 0, width, height);
    g.fillStyle = "#fbede3"; g.fillRect(x(v.t[v.trained]), top, x(v.t[n - 1]) - x(v.t[v.trained]), height - top - bottom);
    g.fillStyle = "#b5b5b5";
    for (let j = 0; j < n; j++) { g.beginPath(); g.arc(x(v.t[j]), y(v.data[j]), 3, 0, 7); g.fill(); }
    line(0, Math.min(v.trained, k), "#0072b2");
    if (k > v.trained) line(v.trained, k, "#d55e00");
    g.strokeStyle = "#222"; g.lineWidth = 1; g.beginPath(); g.moveTo(x(v.t[k]), top); g.lineTo(x(v.t[k]), height - bottom); g.stroke();
    g.fillStyle = "#222"; g.font = font;
    g.fillText(short(high, 3), 4, y(high) + 4); g.fillText(short(low, 3), 4, y(low) + 4);
    g.fillText(short(v.t[0], 4), left, height - 10);
    g.textAlign = "right"; g.fillText(`${short(v.t[n - 1], 4)} ${v.time_unit}`, width - right, height - 10); g.textAlign = "left";
    const m = v.model[k];
    output.textContent = `t = ${short(v.t[k], 5)} ${v.time_unit}: ${v.name} recorded ${v.data[k].toPrecision(4)}, model ` +
      (m === null ? "failed" : `${m.toPrecision(4)}, difference ${short(v.data[k] - m, 2)}`) + ` ${v.unit}`;
  };
  input.addEventListener("input", draw);
  input.value = n - 1;
  draw();
}
