const form = document.querySelector("form"), body = document.querySelector("tbody"), rows = [...body.rows];
const shown = document.getElementById("shown");
let texts = null;
function filter() {
  const words = form.words.value.toLowerCase().split(/\s+/).filter(Boolean);
  texts ??= rows.map(row => row.textContent.toLowerCase());
  let count = 0;
  for (const [i, row] of rows.entries()) {
    row.hidden = !(words.every(word => texts[i].includes(word)) &&
      (!form.status.value || row.dataset.status === form.status.value) &&
      (!form.flagged.checked || row.dataset.flagged === "yes"));
    count += !row.hidden;
  }
  shown.textContent = count + " of " + rows.length + " shown";
}
function order() {
  const key = form.order.value, value = row => row.dataset[key];
  const compare = key === "patient" ? new Intl.Collator("en", {numeric: true}).compare
    : (a, b) => (a === "") - (b === "") || a - b;
  body.append(...[...rows].sort((a, b) => compare(value(a), value(b)) || a.dataset.worst - b.dataset.worst));
}
form.hidden = false;
form.addEventListener("input", filter);
form.order.addEventListener("input", order);
form.addEventListener("submit", event => event.preventDefault());
shown.textContent = rows.length + " of " + rows.length + " shown";
