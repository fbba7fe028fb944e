"""Evaluation results in the format of results.json, with known numbers."""


def metric(title="PSNR", *, unit="dB", higher=True, digits=2):
    about = f"Definition of {title}."
    return {
        "title": title,
        "unit": unit,
        "higher_is_better": higher,
        "digits": digits,
        "definition": about,
    }


METRICS = {"psnr": metric(), "lpips": metric("LPIPS", unit="", higher=False, digits=3)}
SETS = ["real20", "nature20", "postcard", "solidobject", "wildscene"]


def entry(mean, count=20, low=None, high=None):
    return {"mean": mean, "low": low, "high": high, "count": count}


def known_results():
    selections = {key: {"title": key.title(), "cases": 20} for key in SETS}
    selections["average"] = {"title": "Average", "cases": 100}
    table = {
        "input (unprocessed)": {"psnr": entry(20.0, low=18.5, high=21.25), "lpips": entry(0.2)},
        "A_b|c": {"psnr": entry(21.5), "lpips": entry(0.1234)},
    }
    pair = {"method": "A_b|c", "reference": "input (unprocessed)"}
    rows = [
        pair | {"metric": "psnr", "improved_count": 15} | entry(1.5, low=-0.25, high=3.0),
        pair | {"metric": "lpips", "improved_count": 20} | entry(-0.0766),
    ]
    benchmark = {
        "title": "Real20",
        "remarks": ["found 19 images"],
        "excluded": ["x.png has no partner"],
    }
    return {
        "protocol": {"choices": ["Nothing is resized."]},
        "metrics": dict(METRICS),
        "selections": selections,
        "benchmarks": {"real20": benchmark},
        "methods": {
            "input (unprocessed)": {},
            "A_b|c": {"remark": "2 images in the folder match no case"},
        },
        "unavailable": {"lpips_region": "no weights"},
        "unmeasured": ["removed_white"],
        "cases": [{"errors": {"A_b|c": "A_b|c failed on real20/3"}}],
        "tables": dict.fromkeys(selections, table),
        "differences": dict.fromkeys(selections, rows),
    }
