// The sidebar shows the current page.
const list = document.querySelector(".sidebar-scroll"), page = list?.querySelector(".current-page");
if (page) list.scrollTop = page.offsetTop - list.clientHeight / 2;

// Figures outside the doors are links to their full size; wide figures scroll on a phone.
for (const image of document.querySelectorAll("article p > img")) {
  if (image.closest(".door")) continue;
  const link = Object.assign(document.createElement("a"), { href: image.src, title: "Full size" });
  image.replaceWith(link);
  link.append(image);
  image.decode().then(() => image.classList.toggle("wide", image.naturalWidth > 1.3 * image.naturalHeight && !image.src.endsWith("replay.png")), () => {});
}

// Short inline code is not broken; longer code must fit a narrow page.
for (const code of document.querySelectorAll("article code.literal")) code.classList.toggle("short", code.textContent.length <= 16);

// A block that a reader saves has the name of its file.
for (const name of document.querySelectorAll("article p code")) {
  const block = /Save this as $/.test(name.previousSibling?.textContent ?? "") && name.closest("p").nextElementSibling?.querySelector(".highlight");
  if (block) block.dataset.file = name.textContent;
}
