// What all drawn parts of a page share: colours of the page's style, layout and axes of Plotly.
const skidloc = (() => {
  const root = document.documentElement;
  root.classList.add("has-script");
  const colour = name => getComputedStyle(root).getPropertyValue("--" + name).trim();
  return {
    colour,
    config: {responsive: true, displaylogo: false, scrollZoom: true, modeBarButtonsToRemove: ["select2d", "lasso2d", "autoScale2d"]},
    // Index of the last number of sorted `t` that is not after `value`.
    before: (t, value) => {
      let low = 0, high = t.length - 1;
      while (low < high) {
        const middle = (low + high + 1) >> 1;
        if (t[middle] <= value) low = middle; else high = middle - 1;
      }
      return low;
    },
    layout: more => ({
      paper_bgcolor: colour("paper"), plot_bgcolor: colour("paper"), font: {color: colour("ink"), family: "inherit", size: 12},
      margin: {l: 58, r: 34, t: 8, b: 42}, modebar: {orientation: "v"}, legend: {orientation: "h", y: 1.06, yanchor: "bottom"}, hovermode: "closest", ...more,
    }),
    // Of a logarithmic axis upwards: whole numbers in place of digits between powers.
    logTicks: {tickformat: "~g", nticks: 4},
    axis: (title, more) => ({title: {text: title}, gridcolor: colour("rule"), linecolor: colour("rule"), zeroline: false, ...more}),
    onTheme: draw => matchMedia("(prefers-color-scheme: dark)").addEventListener("change", draw),
  };
})();
