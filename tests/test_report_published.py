import pytest

from brewster.evaluate.report.tables import read_published

IMAGE_COUNTS = {"real20": 20, "nature20": 20, "postcard20": 20, "solidobject20": 20, "wildscene101": 101}
ROWS = read_published()
AVERAGED = [row for row in ROWS if "average181" in row.scores]


@pytest.mark.parametrize("row", AVERAGED, ids=lambda row: f"{row.copied_from[:7]} {row.method}")
def test_a_printed_average_is_the_mean_weighted_by_the_numbers_of_images(row):
    for metric, average in row.scores["average181"].items():
        mean = sum(count * float(row.scores[name][metric]) for name, count in IMAGE_COUNTS.items()) / 181
        digits = len(average.partition(".")[2])
        assert abs(mean - float(average)) <= 0.5001 * 10**-digits, metric
