"use strict";
(() => {
  const by = (id) => document.getElementById(id);
  const make = (tag, words, name) => {
    const made = document.createElement(tag);
    if (words !== undefined) made.textContent = words;
    if (name) made.className = name;
    return made;
  };
  const SECONDS = 20;  // time span of the charts
  const FIGURES_MS = 90;  // figures and charts are drawn this often
  const canvas = by("image"), pen = canvas.getContext("2d");
  let about = null, samples = [], latest = null, picture = null, held = false, over = false, asked = false, drawn = [], came = [], figuresAt = 0;

  // The displayed figures, by the fields of a sample ---------------------------------------------------------------
  const number = (value, digits) => value === null || value === undefined ? "–"
    : (Math.abs(value) < 0.5 / 10 ** digits ? 0 : value).toLocaleString("en", { minimumFractionDigits: digits, maximumFractionDigits: digits });
  const CHARTS = [
    { title: "Slip probability", fields: ["probability"], names: ["probability"], unit: "", digits: 2, low: 0, high: 1, level: "threshold" },
    { title: "Gripper position", fields: ["position_ticks", "goal_ticks"], names: ["position", "goal"], unit: "ticks", digits: 0 },
    { title: "Gripper current", fields: ["current_ma", "goal_ma"], names: ["current", "goal"], unit: "mA", digits: 0 },
    { title: "Force on the gel, estimated", fields: ["normal_n", "shear_n"], sds: ["normal_sd_n", "shear_sd_n"], names: ["normal", "shear"],
      unit: "N", digits: 2, low: 0 },
    { title: "Torsion, estimated", fields: ["torsion_n_mm"], sds: ["torsion_sd_n_mm"], names: ["torsion"], unit: "N mm", digits: 2 },
    { title: "Events", fields: ["events_per_s"], names: ["rate"], unit: "1/s", digits: 0, low: 0 },
    { title: "Delay of slices", fields: ["late_ms", "late_most_ms"], names: ["median", "maximum"], unit: "ms", digits: 2, low: 0 },
  ];
  const PHASES = ["contact", "lift", "balance"];

  function tiles() {
    const now = samples.length ? samples[samples.length - 1] : {};
    const [began, ended] = [came[0], came[came.length - 1]];
    const pace = came.length > 1 ? (ended.slices - began.slices) / (ended.at - began.at) * 1000 : null;
    const recent = drawn.filter((time) => time > performance.now() - 2000);
    const rate = recent.length > 1 ? (recent.length - 1) / (recent[recent.length - 1] - recent[0]) * 1000 : null;
    const rows = [
      ["time", `${number(now.t, 1)} s`, PHASES[now.phase] || ""],
      ["slices", `${number(pace, 0)} /s`, "1000 is real time"],
      ["pictures", `${number(rate, 0)} /s`, latest && latest.left_out ? `${number(latest.left_out, 0)} slices not shown` : ""],
      ["events", `${number(now.events_per_s, 0)} /s`, ""],
      ["events lost", latest ? latest.lost : "–", latest ? latest.lost_why : "", latest && latest.lost !== "0"],
      ["longest delay", `${number(now.late_most_ms, 1)} ms`, ""],
    ];
    if (now.probability !== undefined && now.probability !== null)
      rows.push(["slip", number(now.probability, 2), about.threshold === null ? "" : `threshold ${number(about.threshold, 2)}`,
                 about.threshold !== null && now.probability >= about.threshold]);
    if (now.position_ticks !== undefined)
      rows.push(["gripper", `${number(now.position_ticks, 0)} ticks`, now.goal_ticks === null ? "" : `goal ${number(now.goal_ticks, 0)}`],
                ["current", `${number(now.current_ma, 0)} mA`, now.goal_ma === null ? "" : `goal ${number(now.goal_ma, 0)}`]);
    if (now.missed) rows.push(["commands missed", number(now.missed, 0), "", true]);
    if (now.normal_n !== undefined && now.normal_n !== null)
      rows.push(...[["normal force", "normal", "n", "N"], ["shear force", "shear", "n", "N"], ["torsion", "torsion", "n_mm", "N mm"]].map(
        ([name, field, unit, text]) => [name, `${number(now[`${field}_${unit}`], 2)} ${text}`,
                                        `${now[`${field}_sd_${unit}`] === null ? "no touch" : `± ${number(now[`${field}_sd_${unit}`], 2)}`}, estimated`]));
    by("tiles").replaceChildren(...rows.map(([name, value, small, alarm]) => {
      const tile = make("div", undefined, alarm ? "alarm" : "");
      const shown = make("dd", value);
      if (small) shown.append(make("small", small));
      tile.append(make("dt", name), shown);
      return tile;
    }));
  }

  // Charts ---------------------------------------------------------------------------------------------------------
  const charts = CHARTS.map((chart) => {
    const box = make("div", undefined, "chart"), head = make("h2", chart.title), legend = make("span", undefined, "legend");
    const area = document.createElement("canvas");
    area.setAttribute("role", "img");
    area.setAttribute("aria-label", `${chart.title} of the last ${SECONDS} s`);
    head.append(legend);
    box.append(head, area);
    by("charts").append(box);
    return { ...chart, box, legend, area };
  });

  function lines() {
    const style = getComputedStyle(document.documentElement);
    const colour = (name) => style.getPropertyValue(name).trim();
    const end = samples.length ? samples[samples.length - 1].t : 0, from = Math.max(0, end - SECONDS);
    const shown = samples.filter((sample) => sample.t >= from);
    for (const chart of charts) {
      const values = chart.fields.map((field) => shown.map((sample) => sample[field]));
      const is = (value) => value !== null && value !== undefined;
      // one standard deviation below and above each value, if it has one; never below the start of the axis
      const bands = values.map((series, which) => series.map((value, k) => {
        const sd = chart.sds && shown[k][chart.sds[which]];
        return is(value) && is(sd) ? [Math.max(value - sd, chart.low ?? -Infinity), value + sd] : null;
      }));
      const known = [...values.flat(), ...bands.flat(2)].filter(is);
      chart.box.hidden = known.length === 0;
      if (chart.box.hidden) continue;
      const wide = chart.area.clientWidth, high = chart.area.clientHeight, ratio = window.devicePixelRatio || 1;
      if (chart.area.width !== Math.round(wide * ratio)) { chart.area.width = Math.round(wide * ratio); chart.area.height = Math.round(high * ratio); }
      const ink = chart.area.getContext("2d");
      ink.setTransform(ratio, 0, 0, ratio, 0, 0);
      ink.clearRect(0, 0, wide, high);
      let low = chart.low ?? Math.min(...known), top = chart.high ?? Math.max(...known);
      if (top - low < 1e-9 * Math.max(1, Math.abs(top))) { top += 1; low -= chart.low === undefined ? 1 : 0; }
      const left = 66, x = (t) => left + (wide - left - 4) * (t - from) / SECONDS, y = (value) => high - 16 - (high - 22) * (value - low) / (top - low);
      ink.font = "11px system-ui, sans-serif";
      ink.fillStyle = colour("--quiet");
      ink.strokeStyle = colour("--rule");
      ink.textAlign = "right";
      const digits = Math.max(chart.digits, top - low < 5 ? 1 : 0);
      for (const level of [low, top]) {
        ink.fillText(number(level, digits), left - 6, y(level) + (level === low ? 0 : 8));
        ink.beginPath(); ink.moveTo(left, y(level)); ink.lineTo(wide - 4, y(level)); ink.stroke();
      }
      ink.textAlign = "left";
      ink.fillText(`${number(from, 0)} s`, left, high - 3);
      ink.textAlign = "right";
      ink.fillText(`${number(from + SECONDS, 0)} s`, wide - 4, high - 3);
      if (chart.level && about[chart.level] !== null) {
        ink.setLineDash([4, 3]);
        ink.strokeStyle = colour("--quiet");
        ink.beginPath(); ink.moveTo(left, y(about[chart.level])); ink.lineTo(wide - 4, y(about[chart.level])); ink.stroke();
        ink.setLineDash([]);
      }
      const names = [];
      values.forEach((series, which) => {
        if (!series.some(is)) return;
        ink.fillStyle = ink.strokeStyle = colour(which ? "--second" : "--accent");
        ink.globalAlpha = 0.2;
        let edge = [];  // upper edge of the band, up to a gap; then the lower edge in reverse
        [...bands[which], null].forEach((band, k) => {
          if (band) { edge.push([x(shown[k].t), y(band[1]), y(band[0])]); return; }
          ink.beginPath();
          for (const [at, upper] of edge) ink.lineTo(at, upper);
          for (const [at, , lower] of edge.reverse()) ink.lineTo(at, lower);
          ink.fill();
          edge = [];
        });
        ink.globalAlpha = 1;
        ink.lineWidth = 1.5;
        ink.beginPath();
        let open = false;
        series.forEach((value, k) => {
          const here = is(value);
          if (here) { if (open) ink.lineTo(x(shown[k].t), y(value)); else ink.moveTo(x(shown[k].t), y(value)); }
          open = here;
        });
        ink.stroke();
        ink.lineWidth = 1;
        const sd = chart.sds && is(shown[shown.length - 1][chart.sds[which]]) ? ` \u00b1 ${number(shown[shown.length - 1][chart.sds[which]], chart.digits)}` : "";
        names.push(make("i", "", which ? "second" : "first"), ` ${chart.names[which]} ${number(series[series.length - 1], chart.digits)}${sd} ${chart.unit}`);
      });
      chart.legend.replaceChildren(...names);
    }
  }

  // The touch map: its scales end above the recent maximum, at 1, 2 or 5 times a power of 10 ------------------------------
  const highest = { most_kpa: 0, most_shear_kpa: 0 };  // the maximum decays by half in 3 s
  const round = (value) => { const power = 10 ** Math.floor(Math.log10(value)); return [1, 2, 5, 10].map((each) => each * power).find((each) => each >= value); };
  function drawTouch() {
    const map = latest.touch;
    by("touch-card").hidden = !map;
    if (!map) return;
    const size = map.columns * map.rows, drawn = { x: [], y: [], empty: map.known ? "no touch" : "too few dots are tracked", patch: new Uint8Array(size) };
    for (let column = 0; column < map.columns; column++) drawn.x.push(map.x_mm + column * map.cell_mm);
    for (let row = 0; row < map.rows; row++) drawn.y.push(map.y_mm + row * map.cell_mm);
    for (const name of ["pressure", "shear_x", "shear_y"]) drawn[name] = new Float32Array(size);
    for (const name of Object.keys(highest)) highest[name] *= 0.98;
    for (const [, pressure, x, y] of map.cells) {
      highest.most_kpa = Math.max(highest.most_kpa, pressure);
      highest.most_shear_kpa = Math.max(highest.most_shear_kpa, Math.hypot(x, y));
    }
    drawn.most_kpa = round(Math.max(5, highest.most_kpa)); drawn.most_shear_kpa = round(Math.max(2, highest.most_shear_kpa));
    for (const [at, pressure, x, y] of map.cells) {
      drawn.patch[at] = 1;
      drawn.pressure[at] = pressure / drawn.most_kpa;
      drawn.shear_x[at] = x / drawn.most_shear_kpa; drawn.shear_y[at] = y / drawn.most_shear_kpa;
    }
    drawn.centre = map.centre_mm || []; drawn.centre_sd = map.centre_sd_mm || [];
    drawTouchMap(by("touch"), drawn);
    by("touch-legend").textContent = map.area_mm2 ? `${number(map.area_mm2, 0)} mm² of contact` : "";
  }

  // The picture: brighter events in the lower four bits of a pixel's byte, darker ones in the upper four ------------------
  const colours = new Uint32Array(256);  // byte order in memory: red, green, blue, alpha
  for (let value = 0; value < 256; value++) {
    const on = Math.min(1, Math.sqrt((value & 15) / 4)), off = Math.min(1, Math.sqrt((value >> 4) / 4));
    const mix = (back, bright, dark) => Math.round(Math.min(255, back + (bright - back) * on + (dark - back) * off));
    new Uint8Array(colours.buffer, 4 * value, 4).set([mix(16, 255, 78), mix(19, 177, 163), mix(22, 78, 255), 255]);
  }

  function draw() {
    const [width, height] = about.frame_px;
    if (canvas.width !== width || canvas.height !== height) { canvas.width = width; canvas.height = height; picture = null; }
    if (latest.image.length !== width * height) return;
    picture = picture || pen.createImageData(width, height);
    const pixels = new Uint32Array(picture.data.buffer);
    for (let k = 0; k < pixels.length; k++) pixels[k] = colours[latest.image[k]];
    pen.putImageData(picture, 0, 0);
    if (by("window").checked && latest.window_px) {
      const [x0, y0, x1, y1] = latest.window_px;
      pen.lineWidth = 2; pen.strokeStyle = "#d9dde2"; pen.setLineDash([6, 4]);
      pen.strokeRect(x0 + 1, y0 + 1, x1 - x0 - 2, y1 - y0 - 2);
      pen.setLineDash([]);
    }
    const longer = Number(by("arrows").value);
    for (const [x, y, dx, dy, lost] of by("dots").checked ? latest.dots : []) {
      pen.lineWidth = 1.5; pen.strokeStyle = lost ? "#ff5d5d" : "#5be584";
      pen.beginPath(); pen.arc(x, y, 4, 0, 7); pen.stroke();
      const size = Math.hypot(dx, dy) * longer;
      if (lost || size < 1) continue;  // the displacement of a lost dot is unknown
      const tip = [x + dx * longer, y + dy * longer], angle = Math.atan2(dy, dx);
      pen.lineWidth = 2; pen.strokeStyle = "#ffffff";
      pen.beginPath(); pen.moveTo(x, y); pen.lineTo(...tip);
      const head = Math.min(6, size / 2);
      for (const turn of [2.6, -2.6]) { pen.moveTo(...tip); pen.lineTo(tip[0] + head * Math.cos(angle + turn), tip[1] + head * Math.sin(angle + turn)); }
      pen.stroke();
    }
  }

  function know(news) {
    about = news.about;
    samples = about.samples.map(complete);
    document.title = `${about.name} - evetac live`;
    by("name").textContent = about.name;
    by("simulated").hidden = !about.simulated;
    by("let-go").hidden = !about.moves;
    by("notes").replaceChildren(...about.notes.map((note) => make("li", note)));
    by("messages").replaceChildren(...about.messages.map((text) => make("li", text)));
    by("messages-card").hidden = about.messages.length === 0;
  }

  const complete = (sample) => sample.shear_x_n === undefined ? sample
    : { ...sample, shear_n: sample.shear_x_n === null ? null : Math.hypot(sample.shear_x_n, sample.shear_y_n) };

  function show() {
    if (!about || !latest) return;
    for (const part of document.querySelectorAll("[data-for=dots]")) part.hidden = latest.dots.length === 0;
    for (const part of document.querySelectorAll("[data-for=window]")) part.hidden = !latest.window_px;
    if (!held) draw();
    if (performance.now() < figuresAt) return;  // figures need not change as often as pictures
    figuresAt = performance.now() + FIGURES_MS;
    tiles();
    drawTouch();
    lines();
  }

  // The connection: one picture at a time, the next once this one is drawn ---------------------------------------------
  const text = new TextDecoder();
  async function follow() {
    let known = "";
    for (;;) {
      const message = await fetch(`pictures?known=${known}`).then((reply) => reply.ok ? reply.arrayBuffer() : null).catch(() => null);
      if (!message) { end("the connection is lost: the recording program has ended"); return; }
      const size = new DataView(message).getUint32(0, true);
      const news = JSON.parse(text.decode(new Uint8Array(message, 4, size)));
      if (news.ended) { end(news.ended); return; }
      known = news.version;
      take(news, new Uint8Array(message, 4 + size));
      await new Promise(requestAnimationFrame);
      show();
      drawn = [...drawn, performance.now()].slice(-60);
    }
  }

  function take(news, image) {
    came = [...came, { at: performance.now(), slices: news.sample.slices }].slice(-60);
    if (news.about) know(news);
    else samples.push(complete(news.sample));
    while (samples.length && samples[0].t < news.sample.t - 2 * SECONDS) samples.shift();
    latest = { ...news, image };
    by("state").textContent = news.let_go ? "letting go" : news.sample.slices ? "live" : "waiting for the camera";
  }

  function end(why) {
    if (over) return;
    over = true;
    by("state").textContent = `ended: ${why}`;
    by("state").classList.add("ended");
    by("let-go").disabled = true;
  }

  // Buttons and keys -------------------------------------------------------------------------------------------------
  function letGo() {
    if (over || asked || !about || !about.moves) return;
    const pressed = (yes, words) => { asked = by("let-go").disabled = yes; by("let-go").textContent = words; };
    pressed(true, "Letting go");
    fetch("let-go", { method: "POST", body: "{}" }).then((reply) => { if (!reply.ok) throw reply.status; })
      .catch(() => { if (!over) pressed(false, "Let go failed: press again"); });
  }

  function hold() {
    held = !held;
    by("pause").textContent = held ? "Resume" : "Hold";
    by("pause").setAttribute("aria-pressed", String(held));
    show();
  }

  by("let-go").addEventListener("click", letGo);
  by("pause").addEventListener("click", hold);
  for (const id of ["dots", "window", "arrows"]) by(id).addEventListener("change", show);
  window.addEventListener("resize", show);
  document.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.altKey || event.metaKey || event.repeat) return;
    const typing = event.target.tagName === "BUTTON" || event.target.tagName === "SELECT" || event.target.tagName === "INPUT";
    if (event.key === "Escape" && event.target.tagName !== "SELECT") letGo();  // in a menu Esc closes the menu
    else if (event.key === " " && !typing) { event.preventDefault(); hold(); }
    else if (event.key === "d" || event.key === "w") { const box = by(event.key === "d" ? "dots" : "window"); box.checked = !box.checked; show(); }
    else if (event.key === "a") { const menu = by("arrows"); menu.selectedIndex = (menu.selectedIndex + 1) % menu.options.length; show(); }
  });
  follow();
})();
