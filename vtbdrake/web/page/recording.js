// The quality curves of a recording, bound to the clock of its animation. Meshcat's page has run before.

(() => {
  const { curves } = JSON.parse(document.getElementById("vtb-recording").textContent);
  const panel = document.getElementById("vtb-curves");
  const clock = document.getElementById("vtb-clock");
  const { animator } = viewer;

  // All curves in one plot, over the union of their times.
  const [times, ...values] = curves.length ? uPlot.join(curves.map(({ times, values }) => [times, values])) : [[]];
  const size = () => ({ width: panel.clientWidth, height: panel.clientHeight });
  const plot = curves.length
    ? new uPlot(
        {
          ...size(),
          legend: { show: false },
          cursor: { drag: { x: false, y: false }, points: { show: false }, y: false },
          scales: { x: { time: false }, y: { range: (_, least, most) => (least < most ? [least, most] : [least - 1, most + 1]) } },
          axes: [{ label: "time t [s]", size: 30, labelSize: 16 }, { label: "quality f'", size: 54, labelSize: 16 }],
          series: [{}, ...curves.map(({ label, color }) => ({ label, stroke: color, width: 2, spanGaps: true, points: { show: false } }))],
          hooks: { draw: [markStars] },
        },
        [times, ...values],
        panel,
      )
    : null;

  // A ring at (t*, f'(t*)) of each curve.
  function markStars(plot) {
    const { ctx } = plot;
    ctx.save();
    for (const { color, star } of curves) {
      if (!star) continue;
      const [x, y] = [plot.valToPos(star[0], "x", true), plot.valToPos(star[1], "y", true)];
      ctx.beginPath();
      ctx.arc(x, y, 5 * devicePixelRatio, 0, 2 * Math.PI);
      ctx.fillStyle = "white";
      ctx.strokeStyle = color;
      ctx.lineWidth = 2.5 * devicePixelRatio;
      ctx.fill();
      ctx.stroke();
    }
    ctx.restore();
  }

  // A click or a drag in the plot goes to that time; the animation can be played on from there.
  function seek(event) {
    const { left, width } = plot.over.getBoundingClientRect();
    const time = plot.posToVal(Math.min(Math.max(event.clientX - left, 0), width), "x");
    animator.pause();
    animator.display_progress(Math.min(Math.max(time, 0), animator.duration));
    animator.seek(animator.time);
  }

  let now = null;
  if (plot) {
    now = document.createElement("div");
    now.id = "vtb-now";
    plot.over.append(now);
    plot.over.addEventListener("pointerdown", (event) => {
      plot.over.setPointerCapture(event.pointerId);
      seek(event);
    });
    plot.over.addEventListener("pointermove", (event) => event.buttons & 1 && seek(event));
    addEventListener("resize", () => plot.setSize(size()));
  }

  let shown = null;
  function follow() {
    if (animator.time !== shown && animator.duration > 0) {
      shown = animator.time;
      clock.textContent = `t = ${shown.toFixed(2)} s`;
      document.body.dataset.time = shown;
      if (now) now.style.left = `${plot.valToPos(shown, "x")}px`;
    }
    requestAnimationFrame(follow);
  }
  follow();
})();
