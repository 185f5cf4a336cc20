const form = document.querySelector("form"), cards = [...document.querySelectorAll("article")];
const shown = document.getElementById("shown");
let texts = null;
function filter() {
  const words = form.words.value.toLowerCase().split(/\s+/).filter(Boolean);
  texts ??= cards.map(card => card.textContent.toLowerCase());
  let count = 0;
  for (const [i, card] of cards.entries()) {
    card.hidden = !(words.every(word => texts[i].includes(word)) &&
      (!form.status.value || card.dataset.status === form.status.value) &&
      (!form.flagged.checked || card.dataset.flagged === "yes"));
    count += !card.hidden;
  }
  shown.textContent = count + " of " + cards.length + " shown";
}
form.hidden = false;
form.addEventListener("input", filter);
form.addEventListener("submit", event => event.preventDefault());
shown.textContent = cards.length + " of " + cards.length + " shown";
