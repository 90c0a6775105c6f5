// Sorting of tables, zoom and comparison of pictures. Without it the page still shows all tables, plots and pictures.
"use strict";
(() => {
  const all = (selector, root = document) => [...root.querySelectorAll(selector)];
  const clamp = (value, low, high) => Math.min(Math.max(value, low), high);

  // A column's head sorts the rows of every block, the best first; a third press restores the order.
  const valueOf = (row, column) => {
    const cells = [...row.cells].filter((cell) => cell.colSpan === 1);
    const text = cells.length === row.cells.length ? cells[column].dataset.value : "";
    return !text ? null : text === "inf" ? Infinity : Number(text);
  };
  for (const table of all(".results")) {
    const heads = all("th[data-rising]", table);
    const bodies = all("tbody", table).map((body) => [body, all("tr:not(.block)", body)]);
    heads.forEach((head, index) => {
      const button = document.createElement("button");
      button.type = "button";
      button.append(...head.childNodes);
      head.append(button);
      head.setAttribute("aria-sort", "none");
      button.addEventListener("click", () => {
        const best = head.dataset.rising === "1" ? "ascending" : "descending";
        const worst = best === "ascending" ? "descending" : "ascending";
        const now = head.getAttribute("aria-sort");
        const next = now === "none" ? best : now === best ? worst : "none";
        heads.forEach((other) => other.setAttribute("aria-sort", "none"));
        head.setAttribute("aria-sort", next);
        const sign = next === "ascending" ? 1 : -1;
        for (const [body, rows] of bodies) {
          const sorted = [...rows];
          if (next !== "none")
            sorted.sort((a, b) => {
              const [x, y] = [valueOf(a, index + 1), valueOf(b, index + 1)];
              if (x === null || y === null) return (x === null) - (y === null);
              return x === y ? 0 : x < y ? -sign : sign;
            });
          body.append(...sorted);
        }
      });
    });
  }

  // Zoom of a row of pictures, or of two that are compared: --zoom, and the point (--x, --y) that stays where it is.
  const FACTORS = [1, 2, 4, 8];
  const ARROWS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
  class Zoom {
    constructor(box, buttons) {
      [this.box, this.buttons] = [box, buttons];
      for (const button of buttons) button.addEventListener("click", () => this.set(Number(button.value)));
      this.set(1);
    }
    set(factor) {
      this.factor = factor;
      this.box.style.setProperty("--zoom", factor);
      this.box.classList.toggle("sharp", factor >= 4);
      for (const button of this.buttons) button.setAttribute("aria-pressed", String(Number(button.value) === factor));
      if (factor === 1) this.center(0.5, 0.5);
    }
    center(x, y) {
      this.at = [clamp(x, 0, 1), clamp(y, 0, 1)];
      this.box.style.setProperty("--x", `${100 * this.at[0]}%`);
      this.box.style.setProperty("--y", `${100 * this.at[1]}%`);
    }
    follow(event, frame) {
      const box = frame.getBoundingClientRect();
      if (this.factor > 1) this.center((event.clientX - box.left) / box.width, (event.clientY - box.top) / box.height);
    }
    key(event) {
      const step = { "+": 1, "=": 1, "-": -1 }[event.key];
      const move = ARROWS[event.key];
      if (step) this.set(FACTORS[clamp(FACTORS.indexOf(this.factor) + step, 0, FACTORS.length - 1)]);
      else if (move && this.factor > 1)
        this.center(this.at[0] + (move[0] * 0.2) / this.factor, this.at[1] + (move[1] * 0.2) / this.factor);
      else return;
      event.preventDefault();
    }
  }

  // Two pictures of a row over each other, with a wipe between them.
  const dialog = document.querySelector("dialog");
  const stage = dialog.querySelector(".stage");
  const wipe = dialog.querySelector(".wipe");
  const sides = all("select", dialog);
  const shown = all("img", stage);
  const captions = all(".side", stage);
  const zoom = new Zoom(stage, all(".zoom button", dialog));
  let pictures = [];

  const show = () =>
    sides.forEach((side, k) => {
      const [label, image] = pictures[Number(side.value)];
      [shown[k].src, shown[k].alt, captions[k].textContent] = [image.src, image.alt, label];
    });
  const swap = () => {
    [sides[0].value, sides[1].value] = [sides[1].value, sides[0].value];
    show();
  };
  const cut = (percent) => {
    wipe.value = String(percent);
    stage.style.setProperty("--wipe", `${clamp(percent, 0, 100)}%`);
  };
  const compare = (row, opened) => {
    dialog.querySelector("h3").textContent = row.querySelector("h4").textContent;
    pictures = all(".open", row).flatMap((button) =>
      all("img", button).map((image) => [
        button.dataset.label + (image.className === "error" ? " (error)" : ""),
        image,
      ]),
    );
    for (const side of sides) side.replaceChildren(...pictures.map(([label], k) => new Option(label, k)));
    const visible = all("img", opened).find((image) => image.offsetParent !== null);
    const left = pictures.findIndex(([, image]) => image === visible);
    const truth = pictures.length - 1;
    sides[0].value = String(left);
    sides[1].value = String(left === truth ? 0 : truth);
    zoom.set(1);
    cut(50);
    show();
    dialog.showModal();
    wipe.focus();
  };
  sides.forEach((side) => side.addEventListener("change", show));
  dialog.querySelector(".swap").addEventListener("click", swap);
  dialog.querySelector(".close").addEventListener("click", () => dialog.close());
  dialog.addEventListener("click", (event) => event.target === dialog && dialog.close());
  dialog.addEventListener("keydown", (event) => {
    if (event.target.tagName === "SELECT" || event.ctrlKey || event.metaKey || event.altKey) return;
    if (event.key.toLowerCase() === "x") swap();
    else if (event.target !== wipe || zoom.factor > 1 || !(event.key in ARROWS)) zoom.key(event);
  });
  wipe.addEventListener("input", () => cut(Number(wipe.value)));
  let pressed = false;
  const moved = (event) => {
    const box = stage.getBoundingClientRect();
    if (pressed && (event.pointerType === "mouse" || zoom.factor === 1))
      cut((100 * (event.clientX - box.left)) / box.width);
    else zoom.follow(event, stage);
  };
  stage.addEventListener("pointerdown", (event) => {
    pressed = true;
    stage.setPointerCapture(event.pointerId);
    moved(event);
  });
  stage.addEventListener("pointermove", moved);
  for (const end of ["pointerup", "pointercancel"]) stage.addEventListener(end, () => (pressed = false));

  for (const row of all(".case")) {
    const rowZoom = new Zoom(row, all(".zoom button", row));
    for (const button of all(".open", row)) {
      button.addEventListener("pointermove", (event) => rowZoom.follow(event, button));
      button.addEventListener("keydown", (event) => rowZoom.key(event));
      button.addEventListener("click", () => compare(row, button));
    }
  }
})();
