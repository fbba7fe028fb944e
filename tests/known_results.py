"""Evaluation results in the format of results.json, with known numbers."""

METRICS = {
    "psnr": {
        "title": "PSNR",
        "unit": "dB",
        "higher_is_better": True,
        "digits": 2,
        "definition": "Definition of PSNR.",
    },
    "lpips": {
        "title": "LPIPS",
        "unit": "",
        "higher_is_better": False,
        "digits": 3,
        "definition": "Definition of LPIPS.",
    },
}
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
        pair | {"metric": "psnr", "mean": 1.5, "low": -0.25, "high": 3.0, "improved_count": 15, "count": 20},
        pair
        | {"metric": "lpips", "mean": -0.0766, "low": None, "high": None, "improved_count": 20, "count": 20},
    ]
    return {
        "protocol": {"choices": ["Nothing is resized."]},
        "metrics": dict(METRICS),
        "selections": selections,
        "benchmarks": {
            "real20": {
                "title": "Real20",
                "remarks": ["found 19 images, expected 20"],
                "excluded": ["x.png has no partner"],
            }
        },
        "methods": {"input (unprocessed)": {}, "A_b|c": {"remark": "2 images in the folder match no case"}},
        "unavailable": {"niqe": "no weights"},
        "unmeasured": ["removed_white"],
        "cases": [{"errors": {"A_b|c": "A_b|c failed on real20/3"}}],
        "tables": dict.fromkeys(selections, table),
        "differences": dict.fromkeys(selections, rows),
    }
