"""The page's script: sorting, lighting up one method everywhere, zoom and comparison of pictures.

Without it the page still shows all tables, plots and pictures; pictures then open as links.
"""

from __future__ import annotations

SCRIPT = r"""
"use strict";
(() => {
  const all = (selector, root = document) => [...root.querySelectorAll(selector)];
  const make = (name, attributes = {}, ...children) => {
    const node = document.createElement(name);
    for (const [key, value] of Object.entries(attributes)) node.setAttribute(key, value);
    node.append(...children);
    return node;
  };
  const clamp = (value, low, high) => Math.min(Math.max(value, low), high);

  // ---- tables: a column's head sorts the rows of every block, the best first; a third press restores the order
  const figure = (row, column) => {
    const cell = row.cells[column];
    const text = cell && cell.dataset.v;
    return !text ? null : text === "inf" ? Infinity : Number(text);
  };
  for (const table of all(".results")) {
    const heads = all("thead tr:last-child th[data-rising]", table);
    const start = new Map(all("tbody", table).map((body) => [body, all("tr:not(.block)", body)]));
    heads.forEach((head, place) => {
      const button = make("button", { type: "button" });
      button.append(...head.childNodes);
      head.append(button);
      head.setAttribute("aria-sort", "none");
      button.addEventListener("click", () => {
        const best = head.dataset.rising === "1" ? "ascending" : "descending";
        const other = best === "ascending" ? "descending" : "ascending";
        const now = head.getAttribute("aria-sort");
        const next = now === "none" ? best : now === best ? other : "none";
        heads.forEach((h) => h.setAttribute("aria-sort", "none"));
        head.setAttribute("aria-sort", next);
        const sign = next === "ascending" ? 1 : -1;
        for (const [body, rows] of start) {
          const sorted = [...rows];
          if (next !== "none")
            sorted.sort((a, b) => {
              const [x, y] = [figure(a, place + 1), figure(b, place + 1)];
              if (x === null || y === null) return (x === null) - (y === null);
              return x === y ? 0 : x < y ? -sign : sign;
            });
          body.append(...sorted);
        }
      });
    });
  }

  // ---- one method, lit up in the table and the plots of its section
  for (const section of all("section")) {
    const named = all(".results [data-m], .chart [data-m]", section);
    const light = (name) => {
      section.classList.toggle("lit-on", name !== null);
      for (const node of named) node.classList.toggle("lit", node.dataset.m === name);
    };
    for (const node of named) {
      node.addEventListener("pointerenter", () => light(node.dataset.m));
      node.addEventListener("pointerleave", () => light(null));
    }
  }

  // ---- zoom, for a row of pictures or for two that are compared
  const FACTORS = [1, 2, 4, 8];
  class Zoom {
    constructor(box) {
      this.box = box;
      this.factor = 1;
      this.at = [0.5, 0.5];
      this.buttons = FACTORS.map((factor) => {
        const button = make("button", { type: "button", "aria-label": `Zoom ${factor} times` }, `${factor}×`);
        button.addEventListener("click", () => this.set(factor));
        return button;
      });
      this.tools = make("div", { class: "segments", role: "group", "aria-label": "Zoom" }, ...this.buttons);
      this.set(1);
    }
    set(factor) {
      this.factor = factor;
      this.box.style.setProperty("--zoom", factor);
      this.box.classList.toggle("sharp", factor >= 4);
      this.buttons.forEach((button, k) => button.setAttribute("aria-pressed", String(FACTORS[k] === factor)));
      if (factor === 1) this.look(0.5, 0.5);
    }
    look(x, y) {
      this.at = [clamp(x, 0, 1), clamp(y, 0, 1)];
      this.box.style.setProperty("--x", `${100 * this.at[0]}%`);
      this.box.style.setProperty("--y", `${100 * this.at[1]}%`);
    }
    follow(event, frame) {
      const box = frame.getBoundingClientRect();
      if (this.factor > 1) this.look((event.clientX - box.left) / box.width, (event.clientY - box.top) / box.height);
    }
    key(event) {
      const place = FACTORS.indexOf(this.factor);
      const turn = { "+": 1, "=": 1, "-": -1 }[event.key];
      const move = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[event.key];
      if (turn) this.set(FACTORS[clamp(place + turn, 0, FACTORS.length - 1)]);
      else if (move && this.factor > 1) {
        const step = 0.2 / this.factor;
        this.look(this.at[0] + move[0] * step, this.at[1] + move[1] * step);
      } else return false;
      event.preventDefault();
      return true;
    }
  }

  // ---- comparing two pictures of a row
  class Viewer {
    constructor() {
      this.under = make("img", { alt: "" });
      this.over = make("img", { alt: "" });
      this.overBox = make("div", { class: "over" }, this.over);
      this.names = [make("span", { class: "side" }), make("span", { class: "side" })];
      const edge = make("div", { class: "edge" });
      this.stage = make("div", { class: "stage" }, this.under, this.overBox, edge, ...this.names);
      this.zoom = new Zoom(this.stage);
      this.left = make("select");
      this.right = make("select");
      this.title = make("h3");
      const swap = make("button", { type: "button", class: "plain" }, "Swap");
      const close = make("button", { type: "button", class: "close", "aria-label": "Close" }, "×");
      const bar = make("div", { class: "bar" }, this.title, make("label", {}, "Left", this.left),
        make("label", {}, "Right", this.right), swap, this.zoom.tools, close);
      this.wipe = make("input", { type: "range", class: "wipe", min: 0, max: 100, step: 0.5, "aria-label": "Wipe" });
      const hint = make("p", { class: "hint" });
      for (const [key, what] of [["X", "swap"], ["+", "and"], ["−", "zoom"], ["arrows", "move"], ["Esc", "close"]])
        hint.append(make("kbd", {}, key), ` ${what}  `);
      this.dialog = make("dialog", { "aria-label": "Compare two pictures" }, bar, this.stage, this.wipe, hint);
      document.body.append(this.dialog);
      swap.addEventListener("click", () => this.swap());
      close.addEventListener("click", () => this.dialog.close());
      this.left.addEventListener("change", () => this.show());
      this.right.addEventListener("change", () => this.show());
      this.wipe.addEventListener("input", () => this.cut(Number(this.wipe.value)));
      this.dialog.addEventListener("click", (event) => event.target === this.dialog && this.dialog.close());
      this.dialog.addEventListener("keydown", (event) => this.key(event));
      let held = false;
      const moved = (event) => {
        const box = this.stage.getBoundingClientRect();
        if (held && (event.pointerType === "mouse" || this.zoom.factor === 1))
          this.cut((100 * (event.clientX - box.left)) / box.width);
        else this.zoom.follow(event, this.stage);
      };
      this.stage.addEventListener("pointerdown", (event) => {
        held = true;
        this.stage.setPointerCapture(event.pointerId);
        moved(event);
      });
      this.stage.addEventListener("pointermove", moved);
      for (const end of ["pointerup", "pointercancel"]) this.stage.addEventListener(end, () => (held = false));
    }
    open(row, link) {
      this.title.textContent = row.dataset.title;
      this.pictures = all("li a", row).flatMap((a) =>
        all("img", a).map((img) => [a.dataset.label + (img.className === "error" ? " (error)" : ""), img]));
      for (const select of [this.left, this.right])
        select.replaceChildren(...this.pictures.map(([label], k) => make("option", { value: k }, label)));
      const shown = all("img", link).find((img) => img.offsetParent !== null);
      const chosen = this.pictures.findIndex(([, img]) => img === shown);
      const truth = this.pictures.length - 1;
      const input = this.pictures.findIndex(([, img]) => img.className === "result" && img !== shown);
      this.left.value = String(chosen);
      this.right.value = String(chosen === truth ? Math.max(input, 0) : truth);
      this.zoom.set(1);
      this.cut(50);
      this.show();
      this.dialog.showModal();
      this.wipe.focus();
    }
    show() {
      const sides = [[this.under, this.left, 0], [this.over, this.right, 1]];
      for (const [picture, select, k] of sides) {
        const [label, source] = this.pictures[Number(select.value)];
        picture.src = source.getAttribute("src");
        picture.alt = source.alt;
        this.names[k].textContent = label;
      }
    }
    swap() {
      [this.left.value, this.right.value] = [this.right.value, this.left.value];
      this.show();
    }
    cut(share) {
      this.wipe.value = String(share);
      this.stage.style.setProperty("--wipe", `${clamp(share, 0, 100)}%`);
    }
    key(event) {
      if (event.target.tagName === "SELECT" || event.ctrlKey || event.metaKey || event.altKey) return;
      if (event.key === "x" || event.key === "X") this.swap();
      else if (event.target !== this.wipe || this.zoom.factor > 1 || !event.key.startsWith("Arrow"))
        this.zoom.key(event);
    }
  }

  let viewer = null;
  for (const row of all(".case")) {
    const zoom = new Zoom(row);
    row.querySelector(".case-head").append(zoom.tools);
    for (const link of all(".tiles a", row)) {
      link.addEventListener("pointermove", (event) => zoom.follow(event, link));
      link.addEventListener("keydown", (event) => zoom.key(event));
      link.addEventListener("click", (event) => {
        if (event.ctrlKey || event.metaKey || event.shiftKey) return;
        event.preventDefault();
        viewer ??= new Viewer();
        viewer.open(row, link);
      });
    }
  }
})();
"""
