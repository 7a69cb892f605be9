"""C5 and C10: pressing on a hard stop, and the same with Fmax = Td (fig:4 right, fig:7)."""

import numpy as np

from sweeps.paper.record import Claim, Evidence, Findings, Reading
from sweeps.paper.studies import Study, contact, impact, run, welded
from sweeps.paper.welded import about, parts

HALF_DECADE = 10**0.5  # "about 10^-1" is taken as within this factor
VISIBLE = 0.01  # of Td, a residual that a figure shows


def c5(reading: Reading) -> Findings:
    """Errors and settling time of the study from contact."""
    study = contact(reading)
    tail, time = study.metrics.nmse_tail, study.metrics.convergence_time
    good = (tail >= 0.1 / HALF_DECADE) & (tail <= 0.1 * HALF_DECADE)
    evidence = (
        Evidence("nmse of the last 5 s", tail, good, "0.03 to 0.3"),
        about("convergence time, s", time, 1.0),
    )
    reached = study.printed & (study.params["Td"] <= 15.0) & (study.params["K0"] <= 100.0)
    named = study.printed & (study.params["K0"] == 100.0) & (study.params["Td"] == 5.0)
    numbers = {
        "median": float(np.median(tail[reached])),
        "largest": float(tail[reached].max()),
        "named": float(tail[named][0]),
        "welded": float(welded(reading).metrics.nmse_tail[named][0]),
        "time": float(np.median(time[reached])),
        "good": int((good & study.printed).sum()),
        "both": int((good & evidence[1].good & study.printed).sum()),
        "all": int(study.printed.sum()),
    }
    key = f"nmse of the last 5 s {numbers['named']:.2g} at K0 = 100, Td = 5"
    return Findings(study.names("K0", "Td"), evidence, study.conditions(parts(study)), key, numbers)


def c10(reading: Reading) -> Findings:
    """The studies of contact and impact once more, with Fmax = Td."""
    studies = (contact(reading), impact(reading))
    limited = [_limited(study, reading) for study in studies]
    before, after = (
        np.concatenate([s.metrics.convergence_time for s in group]) for group in (studies, limited)
    )
    residual = np.concatenate([abs(s.metrics.steady_error) for s in limited])
    evidence = (
        Evidence("|mean error| of the last 5 s", residual, residual <= VISIBLE, f"<= {VISIBLE:g}"),
        Evidence("convergence time, s", after, after <= before, "<= that with Fmax = 15"),
        Evidence("the same with Fmax = 15", before, np.ones(len(before), bool), "for comparison"),
    )
    whole = _joined(studies)
    hit = whole.params["gap"] > 0.0
    soft = whole.params["K0"] <= 100.0
    conditions = {
        "": np.ones(len(hit), bool),
        "K0 <= 100": soft,
        "K0 <= 100 and in contact from the start": soft & ~hit,
        "K0 <= 10 and in contact from the start": (whole.params["K0"] <= 10.0) & ~hit,
        "K0 = 100 and in contact from the start": (whole.params["K0"] == 100.0) & ~hit,
        "approaching from 0.5 rad": hit,
        "approaching from 0.5 rad and Denv > 0": hit & (whole.params["Denv"] > 0.0),
    }
    numbers = _c10_numbers(whole, residual, before, after)
    key = f"residual gone in {numbers['gone']} of {numbers['all']}, "
    key += f"sooner in {numbers['sooner']}"
    far, near = whole.names("Kenv", "Denv"), whole.names("K0", "Td")
    names = [f"0.5 rad, {far[i]}" if hit[i] else f"contact, {near[i]}" for i in range(len(hit))]
    return Findings(names, evidence, whole.conditions(conditions), key, numbers)


def _c10_numbers(
    whole: Study, residual: np.ndarray, before: np.ndarray, after: np.ndarray
) -> dict[str, float]:
    printed = whole.printed
    failing = printed & (residual > VISIBLE)
    stays = float(np.median(residual[failing])) if failing.any() else 0.0
    return {
        "gone": int((printed & (residual <= VISIBLE)).sum()),
        "all": int(printed.sum()),
        "sooner": int((printed & (after <= before)).sum()),
        "never": int((printed & np.isinf(after)).sum()),
        "stays": stays,
    }


def _limited(study: Study, reading: Reading) -> Study:
    fields = {name: column[study.printed] for name, column in study.params.items()}
    del fields["period"]
    return run(fields | {"Fmax": study.column("Td")[study.printed]}, reading, None)


def _joined(studies: tuple[Study, Study]) -> Study:
    """Both studies as one, every field named in either."""
    names = dict.fromkeys(name for study in studies for name in study.params)
    fields = {name: np.concatenate([study.column(name) for study in studies]) for name in names}
    printed = np.concatenate([study.printed for study in studies])
    return Study(fields, printed, studies[0].metrics)


CLAIMS = (
    Claim(
        "C5",
        "Hard stop: error of 10⁻¹, transient of 1 s",
        "The introduction of the contact connection shows an increase of the torque error to about "
        "10⁻¹ of the desired torque even at the regime; the transient increases to about 1 s.",
        "Sec. IV, fig:4 right, fig:7",
        "From contact on a hard stop with Kenv = 100, Denv = 189.7; K0 and Td as in C1; 10 s.",
        "fic-sweep run paper-contact",
        "mse_contact",
        c5,
        {
            "holds": "Error and transient are of the size named in every case.",
            "holds where": "Elsewhere error and transient are not of the size named: up to "
            "K0 = 100, where Td can be reached, the tail is {median:.2g} in the median.",
            "does not hold": "A joint that starts in contact keeps it, and the stop then acts as "
            "the welded spring and damper do: at K0 = 100, Td = 5 the tail is {named:.2g} (welded: "
            "{welded:.2g}), and where Td can be reached and K0 is at most 100 its median is "
            "{median:.2g}, settled in {time:.2g} s. {good} of {all} cases have a tail of the size "
            "named; {both} of them have the transient too. The paper solved contact with a "
            "variable step, in which Algorithm 2 may have advanced once a step of the solver: the "
            "section on the control period shows what that does.",
        },
    ),
    Claim(
        "C10",
        "Fmax = Td removes the residual, and faster",
        "This problem can be solved simply by setting Fmax = Td. This also enables a higher "
        "convergence speed to the desired torque.",
        "Sec. V",
        "The cases of C5 and C6 with Fmax = Td, beside Fmax = 15.",
        "fic-sweep report --only C10",
        "saturation",
        c10,
        {
            "holds": "The residual is gone in all {all} cases, none of them later than with "
            "Fmax = 15.",
            "holds where": "The residual is gone in {gone} of {all} cases; {sooner} settle no "
            "later than with Fmax = 15, {never} never. The motor cannot push beyond Td then, but "
            "it still has to be asked for all of it: unless the first reference, Td/K0, lies well "
            "beyond the travel Td/Kenv, as it does for a soft K0, that is up to the search, as "
            "slow as before.",
            "does not hold": "The residual is gone in {gone} of {all} cases; {sooner} settle no "
            "later than with Fmax = 15, {never} never.",
        },
    ),
)
