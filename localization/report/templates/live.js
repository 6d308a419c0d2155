// Draws the page of `skidloc online --dashboard` from the events of localization/ros/dashboard.py: `history` replaces, `update` adds.
(() => {
  const {colour, config, layout, axis, logTicks} = skidloc;
  const box = id => document.getElementById("live-" + id);
  const verdict = document.querySelector(".verdict b");
  const T = 0, X = 1, Y = 2, HEADING = 3, SIGMA = 4, SIGMA_DEG = 5, NIS = 6, V = 7, W = 8;
  const state = {samples: [], parameters: [], names: [], warnings: [], map: [[], []], scan: [[], []]};
  let isDue = false, ended = "";
  const column = (rows, k) => rows.map(row => row[k] === undefined ? null : row[k]);
  const ellipse = () => {
    if (!state.cov || !state.pose) return [[], []];
    const [a, b, c] = state.cov, mean = (a + c) / 2, r = Math.hypot((a - c) / 2, b), turn = Math.atan2(2 * b, a - c) / 2;
    const long = 2 * Math.sqrt(Math.max(mean + r, 0)), short = 2 * Math.sqrt(Math.max(mean - r, 0)), points = [[], []];
    for (let k = 0; k <= 48; k++) {
      const u = long * Math.cos(k * Math.PI / 24), v = short * Math.sin(k * Math.PI / 24);
      points[0].push(state.pose[0] + u * Math.cos(turn) - v * Math.sin(turn));
      points[1].push(state.pose[1] + u * Math.sin(turn) + v * Math.cos(turn));
    }
    return points;
  };
  const outline = () => {
    if (!state.pose || !state.size) return [[], []];
    const [x, y, yaw] = state.pose, [l, w] = state.size.map(s => s / 2), corners = [[l, w], [1.6 * l, 0], [l, -w], [-l, -w], [-l, w], [l, w]];
    return [corners.map(([u, v]) => x + u * Math.cos(yaw) - v * Math.sin(yaw)), corners.map(([u, v]) => y + u * Math.sin(yaw) + v * Math.cos(yaw))];
  };
  const drawMap = () => {
    const dots = (points, name, color, size) => ({x: points[0], y: points[1], name, mode: "markers", hoverinfo: "skip", marker: {size, color: colour(color)}});
    const line = (points, name, color, width) => ({x: points[0], y: points[1], name, mode: "lines", hoverinfo: "skip", line: {color: colour(color), width}});
    const rows = state.samples;
    const path = {x: column(rows, X), y: column(rows, Y), customdata: rows.map(row => [row[T], row[SIGMA]]), name: "path", mode: "lines",
      line: {color: colour("blue"), width: 2}, hovertemplate: "%{customdata[0]:.1f} s<br>%{x:.2f}, %{y:.2f} m<br>sigma %{customdata[1]:.3g} m<extra></extra>"};
    const traces = [dots(state.map, "map", "grey", 2), dots(state.scan, "scan", "red", 3), path, line(ellipse(), "2 sigma", "orange", 2), line(outline(), "robot", "ink", 2)];
    const width = box("map").clientWidth, size = width < 500 ? width + 40 : Math.min(Math.max(width * .62, 300), 560);
    Plotly.react(box("map"), traces, layout({height: size, dragmode: "pan", uirevision: "map", xaxis: axis("x [m]"),
      yaxis: axis("y [m]", {scaleanchor: "x", scaleratio: 1})}), config);
  };
  const drawTime = () => {
    const rows = state.samples, t = column(rows, T), name = box("parameter").value, k = state.names.indexOf(name);
    const curve = (y, name, color, i, more) => ({x: t, y, name, mode: "lines", yaxis: "y" + (i || ""), line: {color: colour(color), width: 1.4}, hovertemplate: "%{y:.3g}", ...more});
    const traces = [curve(column(rows, SIGMA), "position sigma [m]", "blue", 0), curve(column(rows, SIGMA_DEG), "heading sigma [deg]", "red", 0),
      curve(column(rows, NIS), "NIS (3 expected)", "orange", 2, {mode: "markers", marker: {size: 3, color: colour("orange")}}),
      curve(column(rows, V), "vx [m/s]", "green", 3), curve(column(rows, W), "wz [rad/s]", "purple", 3)];
    const panels = k < 0 ? 3 : 4, titles = ["position sigma [m], heading sigma [deg]", "NIS (3 expected)", "speed [m/s], turn [rad/s]", name + " ± sigma"];
    if (k >= 0) {
      const x = column(state.parameters, T), mean = column(state.parameters, 1 + 2 * k), sigma = column(state.parameters, 2 + 2 * k);
      [1, -1].forEach(sign => traces.push(curve(mean.map((m, i) => m === null ? null : m + sign * sigma[i]), "", "blue", 4, {x, line: {width: 0},
        fill: sign < 0 ? "tonexty" : "none", fillcolor: colour("blue") + "30", showlegend: false, hoverinfo: "skip"})));
      traces.push(curve(mean, name, "blue", 4, {x}));
    }
    const gap = .08, height = (1 - gap * (panels - 1)) / panels, more = {height: 130 * panels + 100, hovermode: "x unified", uirevision: "time",
      xaxis: axis("time [s]", {anchor: "y" + panels}), annotations: []};
    for (let i = 0; i < panels; i++) {
      const top = 1 - i * (height + gap);
      more["yaxis" + (i ? i + 1 : "")] = axis("", {domain: [Math.max(top - height, 0), top], ...(i < 2 ? {type: "log", ...logTicks} : {}), automargin: true});
      more.annotations.push({text: titles[i], xref: "paper", yref: "paper", x: 0, y: top, showarrow: false, xanchor: "left", yanchor: "bottom", font: {size: 12, color: colour("soft")}});
    }
    Plotly.react(box("time"), traces, layout({...more, showlegend: box("time").clientWidth >= 500}), {...config, scrollZoom: false});
  };
  const drawTexts = () => {
    const last = state.samples[state.samples.length - 1], list = box("parameter"), found = state.warnings;
    const added = state.names.filter(name => ![...list.options].some(option => option.value === name));
    added.forEach(name => list.add(new Option(name, name)));
    if (added.length && !list.value) list.value = added.find(name => /^k_0|multiplier/.test(name)) || added[0];
    const items = found.length ? found : ["none"], shown = box("warnings");
    if ([...shown.children].map(item => item.textContent).join("\n") !== items.join("\n")) shown.replaceChildren(...items.map(text => {
      const item = document.createElement("li");
      item.textContent = text;
      return item;
    }));
    if (!last) return;
    const problems = found.length ? found.length + (found.length > 1 ? " problems: see below." : " problem: see below.") : "No fault.";
    verdict.textContent = (ended || (state.robot || "The robot") + " runs. ") + problems;
    box("now").textContent = last[T].toFixed(1) + " s  x " + last[X].toFixed(2) + "  y " + last[Y].toFixed(2) + " m  " + (last[HEADING] * 180 / Math.PI).toFixed(1) + "°"
      + (last[SIGMA] === null ? "" : "  ± " + last[SIGMA].toPrecision(2) + " m");
  };
  const draw = () => { isDue = false; drawTexts(); drawMap(); drawTime(); };
  const drawSoon = () => { if (!isDue) { isDue = true; setTimeout(draw, 300); } };
  const take = isAll => event => {
    const {samples, parameters, ...more} = JSON.parse(event.data);
    Object.assign(state, more);
    for (const [name, rows] of [["samples", samples], ["parameters", parameters]]) state[name] = isAll ? rows : state[name].concat(rows);
    drawSoon();
  };
  const source = new EventSource("events");
  source.addEventListener("history", take(true));
  source.addEventListener("update", take(false));
  source.addEventListener("end", () => { source.close(); ended = "The run has ended. "; drawSoon(); });
  source.addEventListener("error", () => { if (!ended) { verdict.textContent = "The connection is lost; it is tried again."; } });
  box("parameter").addEventListener("change", draw);
  draw();
  skidloc.onTheme(draw);
})();
