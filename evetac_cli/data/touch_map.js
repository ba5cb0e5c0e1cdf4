"use strict";
/* Draws a touch map into a canvas, for the page of `view` and the live page: colour for pressure, arrows for shear.

   map: x and y, middles of the cells in mm from the middle of the frame; most_kpa and most_shear_kpa, the ends of both
   scales; patch, and pressure, shear_x, shear_y as shares of the ends, a number a cell, row by row, or patch null; empty:
   what is said where nothing touches; centre and centre_sd in mm, share that sticks, direction in which the object slides
   in rad, each NaN or left out where it is not known. */
function drawTouchMap(board, map) {
  const VIRIDIS = [[68, 1, 84], [59, 82, 139], [33, 145, 140], [94, 201, 98], [253, 231, 37]];
  const colourOf = (share) => {
    const at = Math.max(0, Math.min(1, share)) * (VIRIDIS.length - 1), low = Math.min(VIRIDIS.length - 2, Math.floor(at));
    return "rgb(" + VIRIDIS[low].map((value, k) => Math.round(value + (VIRIDIS[low + 1][k] - value) * (at - low))).join(",") + ")";
  };
  const tidy = (span, steps) => {  // a round step with at most so many in the span
    const rough = span / steps, power = 10 ** Math.floor(Math.log10(rough));
    return [1, 2, 5, 10].map((each) => each * power).find((each) => each >= rough * (1 - 1e-9));
  };
  const plain = (value) => String(Number(value.toPrecision(6))), is = (value) => Number.isFinite(value);
  const brush = board.getContext("2d"), style = getComputedStyle(document.documentElement);
  const [ink, quiet, rule] = ["--ink", "--quiet", "--rule"].map((name) => style.getPropertyValue(name).trim());
  const columns = map.x.length, rows = map.y.length, pitch = map.x[1] - map.x[0];
  const left = 62, top = 12, right = 172, below = 56, zoom = Math.min(640 / columns, 470 / rows);
  const wide = zoom * columns, high = zoom * rows, broad = Math.round(left + wide + right), tall = Math.round(top + high + below);
  if (board.width !== broad || board.height !== tall) { board.width = broad; board.height = tall; }
  const x = (mm) => left + ((mm - map.x[0]) / pitch + 0.5) * zoom, y = (mm) => top + ((mm - map.y[0]) / pitch + 0.5) * zoom;
  const line = (x0, y0, x1, y1) => { brush.moveTo(x0, y0); brush.lineTo(x1, y1); };
  const pointer = (x0, y0, dx, dy, colour, thick) => {  // drawn twice, dark and wide, then bright and thin: seen on every colour
    const size = Math.hypot(dx, dy), head = Math.min(10, 0.5 * size), ux = dx / size, uy = dy / size;
    for (const [shade, more] of [["rgba(0, 0, 0, 0.7)", 2], [colour, 0]]) {
      brush.strokeStyle = shade; brush.lineWidth = thick + more; brush.beginPath();
      line(x0, y0, x0 + dx, y0 + dy);
      line(x0 + dx - head * (ux - 0.6 * uy), y0 + dy - head * (uy + 0.6 * ux), x0 + dx, y0 + dy);
      brush.lineTo(x0 + dx - head * (ux + 0.6 * uy), y0 + dy - head * (uy - 0.6 * ux)); brush.stroke();
    }
  };

  // Axes in mm ---------------------------------------------------------------------------------------------------------
  brush.clearRect(0, 0, broad, tall);
  brush.lineCap = brush.lineJoin = "round"; brush.font = "20px system-ui, sans-serif";
  brush.fillStyle = quiet; brush.strokeStyle = rule; brush.lineWidth = 1.5;
  const step = tidy(pitch * Math.max(columns, rows), 6), ticks = (list) => {
    const made = [];
    for (let at = Math.ceil(list[0] / step); at * step <= list[list.length - 1]; at++) made.push(at * step);
    return made;
  };
  brush.beginPath();
  for (const mm of ticks(map.x)) { line(x(mm), top, x(mm), top + high); brush.textAlign = "center"; brush.fillText(plain(mm), x(mm), top + high + 24); }
  for (const mm of ticks(map.y)) { line(left, y(mm), left + wide, y(mm)); brush.textAlign = "right"; brush.fillText(plain(mm), left - 8, y(mm) + 7); }
  brush.stroke();
  brush.textAlign = "center"; brush.fillText("mm", left + wide / 2, top + high + 48);
  brush.strokeRect(left, top, wide, high);

  // The scale of colours, and an arrow ---------------------------------------------------------------------------------
  const bar = left + wide + 26, foot = top + high - 76;
  for (let at = top; at < foot; at++) { brush.fillStyle = colourOf((foot - at) / (foot - top)); brush.fillRect(bar, at, 20, 1.5); }
  brush.fillStyle = colourOf(1); brush.beginPath();  // what is higher has the last colour
  line(bar, top, bar + 10, top - 10); brush.lineTo(bar + 20, top); brush.fill();
  brush.fillStyle = brush.strokeStyle = quiet; brush.lineWidth = 2; brush.textAlign = "left";
  const each = tidy(map.most_kpa, 5);
  for (let at = 0; at * each <= map.most_kpa * (1 + 1e-9); at++) {
    const height = foot - (foot - top) * at * each / map.most_kpa;
    brush.beginPath(); line(bar + 20, height, bar + 27, height); brush.stroke();
    brush.fillText(plain(at * each) + (at ? "" : " kPa"), bar + 33, Math.max(height + 7, top + 15));
  }
  const length = 1.15 * zoom, unit = tidy(map.most_shear_kpa, 1.99);
  pointer(bar, top + high - 36, length * unit / map.most_shear_kpa, 0, "#ffffff", 2.2);
  brush.fillText(plain(unit) + " kPa shear", bar, top + high - 6);

  // What is touched ----------------------------------------------------------------------------------------------------
  if (!map.patch || !map.patch.some((one) => one)) {
    brush.textAlign = "center"; brush.fillText(map.empty, left + wide / 2, top + high / 2 - 12);
    return;
  }
  const on = (row, column) => row >= 0 && column >= 0 && row < rows && column < columns && map.patch[row * columns + column];
  const cells = [];
  for (let row = 0; row < rows; row++) for (let column = 0; column < columns; column++)
    if (on(row, column)) cells.push([row, column, left + column * zoom, top + row * zoom, row * columns + column]);
  for (const [, , x0, y0, at] of cells) { brush.fillStyle = colourOf(map.pressure[at]); brush.fillRect(x0, y0, zoom + 0.5, zoom + 0.5); }
  brush.strokeStyle = ink; brush.lineWidth = 3; brush.beginPath();
  for (const [row, column, x0, y0] of cells) {
    if (!on(row - 1, column)) line(x0, y0, x0 + zoom, y0);
    if (!on(row + 1, column)) line(x0, y0 + zoom, x0 + zoom, y0 + zoom);
    if (!on(row, column - 1)) line(x0, y0, x0, y0 + zoom);
    if (!on(row, column + 1)) line(x0 + zoom, y0, x0 + zoom, y0 + zoom);
  }
  brush.stroke();
  for (const [, , x0, y0, at] of cells) {
    const dx = map.shear_x[at] * length, dy = map.shear_y[at] * length;
    if (Math.hypot(dx, dy) > 3) pointer(x0 + (zoom - dx) / 2, y0 + (zoom - dy) / 2, dx, dy, "#ffffff", 2);
  }

  // The centre of pressure with its deviation, the share that sticks, and where the object slides ----------------------------
  const [cx, cy] = map.centre, [sx, sy] = map.centre_sd;
  if (!is(cx) || !is(cy)) return;
  const px = x(cx), py = y(cy), ax = Math.max(8, (sx / pitch) * zoom || 0), ay = Math.max(8, (sy / pitch) * zoom || 0);
  for (const [shade, thick] of [["#ffffff", 7], ["#d55e00", 4]]) {
    brush.strokeStyle = shade; brush.lineWidth = thick; brush.beginPath();
    line(px - ax, py, px + ax, py); line(px, py - ay, px, py + ay); brush.stroke();
  }
  if (!is(map.share)) return;
  const turn = -Math.PI / 2, stuck = turn + 2 * Math.PI * map.share;
  brush.lineCap = "butt";
  for (const [shade, thick, from, to] of [["#ffffff", 11, 0, 7], ["#009e73", 7, turn, stuck], ["#cc79a7", 7, stuck, turn + 2 * Math.PI]]) {
    if (to - from < 1e-6) continue;
    brush.strokeStyle = shade; brush.lineWidth = thick; brush.beginPath(); brush.arc(px, py, 24, from, to); brush.stroke();
  }
  brush.lineCap = "round";
  const [ux, uy] = [Math.cos(map.direction), Math.sin(map.direction)];
  if (is(ux)) pointer(px + 32 * ux, py + 32 * uy, 44 * ux, 44 * uy, "#e86fb0", 5);
}
