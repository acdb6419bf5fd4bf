/** Files out of the page: texts, and the map as a picture with its colours written into it. */
export function saveBlob(blob: Blob, name: string) {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(blob);
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 1000);
}

export const saveText = (text: string, name: string) => saveBlob(new Blob([text], { type: "text/plain" }), name);

const LOOKS = ["fill", "fill-opacity", "stroke", "stroke-width", "stroke-opacity", "opacity", "font-family", "font-weight", "font-style", "text-anchor", "paint-order", "transform"];

export function drawMap(): { text: string; width: number; height: number } {
  const shown = document.querySelector<SVGSVGElement>(".map svg")!;
  const copy = shown.cloneNode(true) as SVGSVGElement;
  const [from, to] = [shown.querySelectorAll("*"), copy.querySelectorAll("*")];
  from.forEach((element, n) => {
    const style = getComputedStyle(element);
    if (element.classList.contains("hit")) to[n].setAttribute("visibility", "hidden");
    const written = LOOKS.filter((name) => name !== "transform" || element.classList.contains("stand"));
    to[n].setAttribute("style", written.map((name) => `${name}:${style.getPropertyValue(name)}`).join(";"));
  });
  const { width, height } = shown.getBoundingClientRect();
  copy.setAttribute("xmlns", "http://www.w3.org/2000/svg");
  copy.setAttribute("width", String(width));
  copy.setAttribute("height", String(height));
  copy.style.background = getComputedStyle(shown).backgroundColor;
  return { text: new XMLSerializer().serializeToString(copy), width, height };
}

export function saveMap(ending: "svg" | "png", name: string) {
  const { text, width, height } = drawMap();
  const svg = new Blob([text], { type: "image/svg+xml" });
  if (ending === "svg") return saveBlob(svg, `${name}.svg`);
  const picture = new Image();
  picture.onload = () => {
    const canvas = document.createElement("canvas");
    [canvas.width, canvas.height] = [2 * width, 2 * height];
    canvas.getContext("2d")!.drawImage(picture, 0, 0, canvas.width, canvas.height);
    canvas.toBlob((png) => png && saveBlob(png, `${name}.png`), "image/png");
  };
  picture.src = `data:image/svg+xml;charset=utf-8,${encodeURIComponent(text)}`;
}
