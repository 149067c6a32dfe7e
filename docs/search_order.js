// Scores of search results: guides before the gallery, both before benchmarks and history.
const ORDER = [
  [/^(benchmarks|changelog|design_notes)$/, -30],
  [/^(quick_start|tutorial|concepts|glossary|questions|cheat_sheet)$|^guides\//, 10],
  [/^gallery\//, -5],
];

// Name and members are those of Sphinx's searchtools.js.
var Scorer = {
  score: ([docname, , , , score]) => score + ORDER.reduce((sum, [name, add]) => (name.test(docname) ? sum + add : sum), 0),
  objNameMatch: 11,
  objPartialMatch: 6,
  objPrio: { 0: 15, 1: 5, 2: -5 },
  objPrioDefault: 0,
  title: 15,
  partialTitle: 7,
  term: 5,
  partialTerm: 2,
};
