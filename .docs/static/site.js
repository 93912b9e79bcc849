// The sidebar shows the current page.
const list = document.querySelector(".sidebar-scroll"), page = list?.querySelector(".current-page");
if (page) list.scrollTop = page.offsetTop - list.clientHeight / 2;
