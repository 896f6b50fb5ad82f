// The quality curves of a recording, bound to the clock of its animation. Meshcat's page has run before.

/** @typedef {{ label: string, color: string, times: number[], values: number[], star: [number, number] }} Curve */

(() => {
  /** @param {string} id */
  const byId = (id) => /** @type {HTMLElement} */ (document.getElementById(id));
  /** @type {{ curves: Curve[] }} */
  const { curves } = JSON.parse(byId("vtb-recording").textContent);
  const panel = byId("vtb-curves");
  const clock = byId("vtb-clock");
  const { animator } = viewer;

  // All curves in one plot, over the union of their times.
  const [times, ...values] = curves.length ? uPlot.join(curves.map((curve) => [curve.times, curve.values])) : [[]];
  const size = () => ({ width: panel.clientWidth, height: panel.clientHeight });
  const plot = curves.length
    ? new uPlot(
        {
          ...size(),
          legend: { show: false },
          cursor: { drag: { x: false, y: false }, points: { show: false }, y: false },
          scales: {
            x: { time: false },
            y: {
              range: (/** @type {any} */ _, /** @type {number} */ least, /** @type {number} */ most) =>
                least < most ? [least, most] : [least - 1, most + 1],
            },
          },
          axes: [
            { label: "time t [s]", size: 30, labelSize: 16 },
            { label: "quality f'", size: 54, labelSize: 16 },
          ],
          series: [
            {},
            ...curves.map(({ label, color }) => ({
              label,
              stroke: color,
              width: 2,
              spanGaps: true,
              points: { show: false },
            })),
          ],
          hooks: { draw: [markStars] },
        },
        [times, ...values],
        panel,
      )
    : null;

  /**
   * A ring at (t*, f'(t*)) of each curve.
   *
   * @param {any} drawn the plot
   */
  function markStars(drawn) {
    const { ctx } = drawn;
    ctx.save();
    for (const { color, star } of curves) {
      if (!star) continue;
      const [x, y] = [drawn.valToPos(star[0], "x", true), drawn.valToPos(star[1], "y", true)];
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

  /**
   * A click or a drag in the plot goes to that time; the animation can be played on from there.
   *
   * @param {PointerEvent} event
   */
  function seek(event) {
    const { left, width } = plot.over.getBoundingClientRect();
    const time = plot.posToVal(Math.min(Math.max(event.clientX - left, 0), width), "x");
    animator.pause();
    animator.display_progress(Math.min(Math.max(time, 0), animator.duration));
    animator.seek(animator.time);
  }

  /** @type {HTMLElement | null} */
  let now = null;
  if (plot) {
    now = document.createElement("div");
    now.id = "vtb-now";
    plot.over.append(now);
    plot.over.addEventListener("pointerdown", (/** @type {PointerEvent} */ event) => {
      plot.over.setPointerCapture(event.pointerId);
      seek(event);
    });
    plot.over.addEventListener("pointermove", (/** @type {PointerEvent} */ event) => event.buttons & 1 && seek(event));
    addEventListener("resize", () => plot.setSize(size()));
  }

  /** @type {number | null} */
  let shown = null;
  function follow() {
    const { time, duration } = animator;
    if (time !== shown && duration > 0) {
      shown = time;
      clock.textContent = `t = ${time.toFixed(2)} s`;
      document.body.dataset.time = String(time);
      if (now) now.style.left = `${plot.valToPos(time, "x")}px`;
    }
    requestAnimationFrame(follow);
  }
  follow();
})();
