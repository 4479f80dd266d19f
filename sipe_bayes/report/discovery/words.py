"""What to think of a search over structures, in sentences: what the model lacks, what it gains, what remains."""

from __future__ import annotations

from pathlib import Path

from sipe_bayes.core.findings import Code, Findings
from sipe_bayes.diagnostics.discovery import Discovery, ModelErrors, Piece
from sipe_bayes.report.verdicts import Verdict
from sipe_bayes.report.words import correlation_time, error_text, listed, significant, unit_text
from sipe_bayes.structure.structures import StructureRow


def nats(value: float | None) -> str:
    """A gain in nats with its sign; a dash where it is not known."""
    return "–" if value is None else f"{value:+.0f}" if abs(value) >= 10 else f"{value:+.1f}"


def found_values(discovery: Discovery, piece: Piece) -> str:
    """The values of a kept piece's parameters with their 90 % intervals; of many the first three."""
    rows = [row for row in value_rows(discovery) if row["added"] and row["name"] in piece.parameters]
    texts = []
    for row in rows[:3]:
        value = f"{row['value']} {row['unit']}".rstrip() + f" ({row['interval']})"
        texts.append(value if len(rows) == 1 else f"{row['name'].rpartition('.')[2]} {value}")
    return listed(texts + [f"{len(rows) - 3} more"] * (len(rows) > 3))


def with_error(value: float, error: float) -> str:
    """A number of nats and its standard error."""
    return f"{nats(value)} ± {nats(error).lstrip('+')}"


def weight_text(row: StructureRow) -> str:
    """The stacking weight of a structure; none of one outside the set that the logs support."""
    return f"{row.weight:.2f}" if row.tied else "–"


def structure_text(row: StructureRow) -> str:
    """What a structure has."""
    return listed(row.sentences) or "the model as it was"


def piece_text(piece: Piece) -> str:
    """An extension, and by how much it raises the log predictive density."""
    gain = "" if piece.gain is None or piece.error is None else f": {with_error(piece.gain, piece.error)} nats"
    return f"{piece.sentence}{gain}"


def alternatives(discovery: Discovery) -> tuple[StructureRow, ...]:
    """The structures that the logs do not tell from the one that is written out."""
    return tuple(row for row in discovery.rows[1:] if row.tied)


def alternative_text(row: StructureRow) -> str:
    """A structure that the logs do not tell apart, and its difference."""
    return f"{structure_text(row)} (difference {with_error(-row.behind, row.behind_error)} nats)"


def headline(discovery: Discovery) -> Verdict:
    """What the model lacks, and how much of it."""
    kept = "; and ".join(", ".join(filter(None, [p.sentence, found_values(discovery, p)])) for p in discovery.kept)
    cut, count = cut_short(discovery), len(discovery.rows)
    if kept and (cut or not discovery.settled):
        among = f"Not all of the {count} structures were fitted to their end; of these"
        if cut:
            among = f"Of the {count} structures that were fitted before the search ended"
        return Verdict("bad", f"{among}, the simplest of the best has {kept}.")
    if kept:
        best = discovery.rows[0]
        gain = f"the log predictive density rises by {with_error(best.gain, best.error).lstrip('+')} nats"
        return Verdict("good" if discovery.passes else "fair", f"The logs support {kept}: {gain}.")
    if discovery.passes and cut:
        return Verdict("fair", "The residuals pass for noise; whether something is lacking was not tried to the end.")
    if discovery.passes:
        return Verdict("good", "Nothing is lacking that these logs would show.")
    why = ", and nothing that was tried is what the model lacks"
    if cut and discovery.pieces:
        why = "; of what was fitted nothing is shown to be lacking yet"
    elif cut:
        why = "; no piece was fitted to its end, so what the model lacks is not known"
    return Verdict("bad", f"The residuals are not noise{why}.")


def held_out_verdict(discovery: Discovery) -> Verdict | None:
    """Whether the extended model predicts held-out logs better than the calibrated plain one."""
    comparison = discovery.comparison
    if comparison is None:
        if not discovery.kept or any(row.use == "holdout" for row in discovery.errors):
            return None
        return Verdict("fair", "No log was held out: only pieces of the training logs speak for it.")
    interval = f"95 % interval {1 / comparison.high:.2f} to {1 / comparison.low:.2f}"
    margin = f"{1 / comparison.ratio:.2f} times that of the plain model, calibrated ({interval}, from best starts)"
    words = {
        "better": ("good", f"On held-out logs its error falls to {margin}."),
        "worse": ("bad", f"On held-out logs its error is LARGER, {margin}."),
        "not better": ("fair", f"On held-out logs it is NOT shown to be better: its error is {margin}."),
    }
    return Verdict(*words[comparison.verdict])


def ties(discovery: Discovery) -> Verdict | None:
    """Which structures the logs do not tell apart, what would, and what is left out since it is not needed."""
    others, best, texts = [alternative_text(row) for row in alternatives(discovery)], discovery.rows[0], list[str]()
    if others:
        named = listed(others[:2] + [f"{len(others) - 2} more"] * (len(others) > 2))
        parts = any(one.code is Code.SEARCHED_ON_PARTS for one in discovery.findings)
        would = "Logs cut to where they differ, or other motions," if parts else "More logs, or other motions,"
        texts.append(f"Within two standard errors these structures predict the logs as well: {named}.")
        texts.append(f"The simplest of them, {structure_text(best)}, is written to discovered.xml. {would} may tell.")
    refused = [structure_text(row) for row in discovery.rows if row.refused]
    if refused:
        named = "; ".join(refused)
        texts.append(f"Refused, since errors on held-out logs are larger than those of the plain model: {named}.")
    larger = max(discovery.rows, key=lambda row: row.gain)
    if not larger.tied and not larger.refused and larger.gain > best.gain and set(best.labels) < set(larger.labels):
        pairs = zip(larger.sentences, larger.labels, strict=True)
        added = listed([sentence for sentence, label in pairs if label not in best.labels])
        gain = with_error(-larger.behind, larger.behind_error)
        worse = -larger.behind > 2 * larger.behind_error
        why = "held-out logs are predicted worse with it" if worse else "less than two standard errors"
        texts.append(f"Adding {added} gains {gain} nats: {why}, so it is left out.")
    return Verdict("fair", " ".join(texts)) if texts else None


def remains(discovery: Discovery) -> Verdict | None:
    """Whether what the best structure leaves passes for noise."""
    misfit = discovery.after.misfit
    if misfit is None:
        return Verdict("fair", "Whether the residuals pass for noise cannot be told.")
    p = f"({misfit.p_text})"
    if not misfit.alarm:
        return Verdict("good", f"What remains passes for noise {p}.")
    if discovery.passes:
        return Verdict("fair", f"What remains is not quite noise {p}: something small, like {misfit.cause}.")
    return Verdict("bad", f"What remains is not noise {p}; it looks most like {misfit.cause}.")


def trust(discovery: Discovery) -> Verdict:
    """Which intervals hold: those stacked over the structures, once residuals pass and the search has settled."""
    cut, widened = cut_short(discovery), any(p.further is not None for p in discovery.parameters)
    if cut is not None and discovery.passes and discovery.best_settled and not alternatives(discovery):
        return Verdict("fair", f"Values may be trusted within the printed intervals, though {cut}.")
    if cut is not None and discovery.kept and discovery.best_settled and widened:
        return Verdict("fair", f"Use values within the intervals with what the model lacks, no narrower: {cut}.")
    if cut is not None:
        return Verdict("bad", f"No value may be trusted yet: {cut}.")
    if not discovery.settled:
        return Verdict("bad", "No value may be trusted yet: the search ended before it had settled; raise its budget.")
    if discovery.passes:
        return Verdict("good", "Values may be trusted within the printed intervals.")
    if widened:
        text = "Use values within the intervals with what the model lacks: the plain ones are those of models that are"
        return Verdict("fair", f"{text} still wrong.")
    text = "No value may be trusted within its interval yet: the intervals are those of models that are still wrong"
    return Verdict("bad", f"{text}.")


def discovery_verdicts(discovery: Discovery) -> list[Verdict]:
    """The answer: at the top of the report, and at the end of what is printed."""
    out = [headline(discovery), held_out_verdict(discovery), ties(discovery)]
    return [verdict for verdict in (*out, remains(discovery), trust(discovery)) if verdict is not None]


def next_steps(discovery: Discovery) -> str:
    """What to do with it."""
    out = Path(discovery.out)
    if discovery.kept:
        alone = "; its intervals hold for this structure alone, those above for all of the set"
        onward = f"sipe calibrate {out / 'discovered.toml'} (the model with these values: {out / 'discovered.xml'})"
        return onward + alone * bool(alternatives(discovery))
    if cut_short(discovery):
        return "run the search again, as said above"
    if discovery.passes:
        return "nothing to put in; go on with the configuration as it is"
    return (
        "record other motions and search again, or write an extension of your own: structure.extra in the configuration"
    )


def residual_lines(discovery: Discovery) -> list[str]:
    """For each channel the size and the correlation time of what remains, before and after."""
    lines = []
    for channel, before in discovery.before.noise.items():
        after = discovery.after.noise[channel]
        sizes = f"sd from {error_text(before.sd)} to {error_text(after.sd)} {unit_text(after.unit)}"
        lines.append(
            f"{channel}: {sizes}, correlation time from {correlation_time(before)} to {correlation_time(after)}"
        )
    return lines


def error_line(row: ModelErrors) -> str:
    """One log and channel: as given, before, after."""
    fitted = f"RMSE {error_text(row.fitted_before)} to {error_text(row.fitted_after)} {unit_text(row.unit)}"
    measured = f"{error_text(row.before)} to {error_text(row.after)} (as given {error_text(row.given)})"
    return f"{row.log}, {row.channel}: {fitted}; from measured starts {measured}"


def value_rows(discovery: Discovery) -> list[dict[str, str]]:
    """The user's parameters stacked over structures, beside those of the plain model; then those that were added."""
    rows = []
    plain = {p.name: p for p in discovery.plain_parameters}
    for p in (*discovery.parameters, *discovery.added):
        scale = max(abs(p.q05), abs(p.q95))
        value, low, high = (significant(x, p.sd, scale) for x in (p.q50, p.q05, p.q95))
        row = {"name": p.name, "unit": unit_text(p.unit), "value": value, "interval": f"{low} to {high}"}
        old = plain.get(p.name)
        texts = [] if old is None else [significant(x, old.sd, scale) for x in (old.q50, old.q05, old.q95)]
        row |= {"before": texts[0] if texts else "", "before_interval": " to ".join(texts[1:])}
        row["further"] = " to ".join(significant(x, p.sd, scale) for x in p.further or ())
        rows.append(row | {"added": "" if old else "yes", "nuisance": "yes" if p.nuisance else ""})
    return rows


def warnings(discovery: Discovery) -> list[str]:
    """What was noticed on the way, but for what the verdicts say."""
    rest = (item for item in discovery.findings if item.code is not Code.STRUCTURES_CUT_SHORT)
    return Findings(rest).warnings


def cut_short(discovery: Discovery) -> str | None:
    """What a search that was cut short did not come to; None where it ended by itself."""
    return next((item.text for item in Findings(discovery.findings).of(Code.STRUCTURES_CUT_SHORT)), None)
