/* Draws the signals that the page holds: a log and a channel are picked, both charts zoom as one. */
"use strict";
(async () => {
  const page = JSON.parse(document.getElementById("signals-data").textContent);
  const packed = Uint8Array.from(atob(page.codes), (letter) => letter.charCodeAt(0));
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
  const bytes = new DataView(await new Response(stream).arrayBuffer());
  const names = ["measured", "default", "mode", "low", "high"];
  const NOTHING = 65535;
  const panel = document.getElementById("signals-panel");
  const part = (name) => panel.querySelector(`[data-part=${name}]`);

  let place = 0;
  for (const log of page.logs)
    for (const channel of log.channels) {
      channel.place = place;
      place += names.length * log.count;
    }

  function series(log, channel, index) {
    const [low, step] = channel[names[index]];
    const values = new Array(log.count);
    let code = 0;
    for (let k = 0; k < log.count; k++) {
      code = (code + bytes.getUint16(2 * (channel.place + index * log.count + k), true)) & NOTHING;
      values[k] = code === NOTHING ? null : low + step * code;
    }
    return values;
  }

  /* time, measured, default, mode, low, high, error; a sample without simulation before each window, where lines end */
  function table(log, channel) {
    const starts = new Set(log.windows);
    const raw = names.map((_, index) => series(log, channel, index));
    const columns = Array.from({ length: 7 }, () => []);
    for (let k = 0; k < log.count; k++) {
      const time = log.start + log.step * k;
      if (k && starts.has(k)) [time, raw[0][k], null, null, null, null, null].forEach((v, i) => columns[i].push(v));
      const error = raw[0][k] === null || raw[2][k] === null ? null : raw[0][k] - raw[2][k];
      [time, ...raw.map((column) => column[k]), error].forEach((v, i) => columns[i].push(v));
    }
    return columns;
  }

  const digits = (chart, value) => (value === null || value === undefined ? "–" : +value.toPrecision(5) + "");
  const line = (key, more) => ({ label: page.labels[key], stroke: page.colours[key], value: digits, width: 1.5, points: { show: false }, ...more });

  /* a tick on the time axis wherever a window starts */
  function marks(chart) {
    const { left, top, width, height } = chart.bbox;
    chart.ctx.strokeStyle = "#999";
    chart.ctx.lineWidth = devicePixelRatio;
    chart.ctx.beginPath();
    for (const k of log.windows) {
      const x = chart.valToPos(log.start + log.step * k, "x", true);
      if (x < left || x > left + width) continue;
      chart.ctx.moveTo(x, top + height);
      chart.ctx.lineTo(x, top + 0.95 * height);
    }
    chart.ctx.stroke();
  }

  function draw(host, height, lines, bands, columns, label) {
    const grid = { stroke: "#e6e6e6", width: 1 }, ticks = { stroke: "#e6e6e6" };
    const axis = { stroke: "#333", grid, ticks, font: "12px system-ui, sans-serif", labelFont: "12px system-ui, sans-serif" };
    const time = { label: "time [s]", value: (chart, value) => (value === null ? "–" : value.toFixed(3)) };
    const options = {
      width: host.clientWidth, height, series: [time, ...lines], bands,
      scales: { x: { time: false } },
      axes: [axis, { ...axis, size: 62, label, labelSize: 20 }],
      cursor: { sync: { key: "signals" }, drag: { x: true, y: false }, points: { size: 6 } },
    };
    const span = (chart, key) => key === "x" && (host.dataset.span = `${chart.scales.x.min} ${chart.scales.x.max}`);
    options.hooks = { draw: [marks], setScale: [span] };
    return new uPlot(options, columns, host);
  }

  let drawn = [], columns = null, log = null;

  function pick() {
    log = page.logs[part("log").value];
    const channel = log.channels[part("channel").value];
    drawn.forEach((chart) => chart.destroy());
    columns = table(log, channel);
    const hidden = { stroke: "transparent", width: 0, show: columns[4].some((value) => value !== null) };
    const above = [
      line("measured", { width: 1 }), line("default", { dash: [5, 4], width: 1, auto: false }), line("mode"),
      line("low", hidden), line("high", hidden),
    ];
    const bands = [{ series: [5, 4], fill: page.colours.mode + "40" }];
    const error = [{ ...line("measured", { width: 1 }), label: `measured − ${page.labels.mode}` }];
    drawn = [
      draw(part("above"), 320, above, bands, columns.slice(0, 6), channel.label),
      draw(part("below"), 190, error, [], [columns[0], columns[6]], channel.error),
    ];
    part("above").setAttribute("aria-label", `${channel.name} of ${log.name}, measured and simulated over time`);
    part("below").setAttribute("aria-label", `${channel.name} of ${log.name}, measured less ${page.labels.mode}`);
  }

  function pickLog() {
    const old = part("channel").value;
    part("channel").replaceChildren(...page.logs[part("log").value].channels.map((c, i) => new Option(c.name, i)));
    if (old && old < part("channel").length) part("channel").value = old;
    pick();
  }

  function show(low, high) {
    const ends = [columns[0][0], columns[0][columns[0].length - 1]];
    const span = Math.min(Math.max(high - low, 4 * log.step), ends[1] - ends[0]);
    const min = Math.min(Math.max(low, ends[0]), ends[1] - span);
    drawn.forEach((chart) => chart.setScale("x", { min, max: min + span }));
  }

  const move = (by, zoom) => () => {
    const { min, max } = drawn[0].scales.x;
    const half = (zoom * (max - min)) / 2, middle = (min + max) / 2 + by * (max - min);
    show(middle - half, middle + half);
  };

  function worst() {
    const at = columns[6].reduce((best, value, k) => (Math.abs(value ?? 0) > Math.abs(columns[6][best] ?? 0) ? k : best), 0);
    const half = Math.max((columns[0][columns[0].length - 1] - columns[0][0]) / 40, 20 * log.step);
    show(columns[0][at] - half, columns[0][at] + half);
  }

  const actions = { earlier: move(-0.5, 1), later: move(0.5, 1), closer: move(0, 0.5), further: move(0, 2), whole: () => show(-Infinity, Infinity), worst };
  Object.entries(actions).forEach(([name, action]) => part(name).addEventListener("click", action));
  part("log").replaceChildren(...page.logs.map((one, i) => new Option(`${one.name} (${one.use})`, i)));
  part("log").addEventListener("change", pickLog);
  part("channel").addEventListener("change", pick);
  panel.hidden = false;
  document.documentElement.classList.add("drawn");
  pickLog();
  new ResizeObserver(() => drawn.forEach((chart) => chart.setSize({ width: part("above").clientWidth, height: chart.height }))).observe(part("above"));
})();
