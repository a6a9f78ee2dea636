"""Lists of rocks in the forms of spreadsheets, of people and of several languages are the same rocks."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxmap.datasets.number_tables import read_number_table
from jaxmap.datasets.rock_list import read_rock_lists
from jaxmap.errors import JaxmapError

ROCKS = np.array([[0.1, 4.3, 0.8], [12.25, -3.0, 1.125]])
FORMS = {
    "spaces": "0.1 4.3 0.8\n12.25 -3 1.125\n",
    "spaces, decimal commas": "0,1 4,3 0,8\n12,25 -3 1,125\n",
    "tabs, decimal commas": "0,1\t4,3\t0,8\n12,25\t-3,0\t1,125\n",
    "commas": "0.1,4.3,0.8\n12.25,-3,1.125\n",
    "commas and spaces": "0.1, 4.3, 0.8\n12.25, -3, 1.125\n",
    "semicolons": "ID;X;Y;Diameter\n1;0.1;4.3;0.8\n2;12.25;-3;1.125\n",
    "semicolons, decimal commas": "ID;X;Y;Diameter\n1;0,1;4,3;0,8\n2;12,25;-3;1,125\n",
    "Excel": '\ufeffsep=;\r\n"ID";"X";"Y";"Diameter"\r\n"1";"0,1";"4,3";"0,8"\r\n"2";"12,25";"-3,0";"1,125"\r\n',
    "quoted decimal commas": 'x,y,diameter\n"0,1","4,3","0,8"\n"12,25","-3","1,125"\n',
    "bars": "x | y | d\n0.1 | 4.3 | 0.8\n12.25 | -3 | 1.125\n",
    "units": "Easting [m];Northing [m];Durchmesser [cm]\n0,1;4,3;80\n12,25;-3;112,5\n",
    "units behind names": "y_m x_m diameter_mm\n4.3 0.1 800\n-3 12.25 1125\n",
    "units after a space": "x (cm)\ty (cm)\tradius (cm)\n10\t430\t40\n1225\t-300\t56.25\n",
    "text beside": "name,x,y,size,comment\nbig one,0.1,4.3,0.8,\nother,12.25,-3,1.125,by the road\n",
}
WITH_COMMAS = {form for form in FORMS if "decimal commas" in form} | {"Excel", "units"}


@pytest.mark.parametrize("form", FORMS)
def test_forms_of_one_list(form, tmp_path):
    path = tmp_path / "rocks.csv"
    path.write_text(FORMS[form], encoding="utf-8")
    found = read_rock_lists([path])
    np.testing.assert_allclose(np.column_stack([found.centres, found.diameters_m]), ROCKS, rtol=1e-12)
    assert any("decimal commas" in note for note in found.notes) == (form in WITH_COMMAS)


def test_thousands_are_no_decimals(tmp_path):
    path = tmp_path / "rocks.csv"
    for text in ("x;y\n595.676,32;5.785.781,65\n", "x;y\n595,676.32;5,785,781.65\n", "x;y\n595 676,32;5'785'781,65\n"):
        path.write_text(text)
        np.testing.assert_allclose(read_rock_lists([path]).centres, [[595_676.32, 5_785_781.65]])


numbers = st.decimals(-10_000, 10_000, places=2).map(str)


@given(
    rows=st.lists(st.tuples(numbers, numbers, numbers), min_size=1, max_size=5),
    separator=st.sampled_from([";", "\t", "|", " "]),
    comma=st.booleans(),
)
def test_numbers_come_back_whatever_the_separator_and_the_decimal_mark(rows, separator, comma, tmp_path_factory):
    path = tmp_path_factory.mktemp("table") / "a.csv"
    text = "\n".join(separator.join(row) for row in rows)
    path.write_text(text.replace(".", ",") if comma else text)
    table = read_number_table(path)
    assert table.decimal_comma == comma
    np.testing.assert_array_equal(
        [[float(cell) for cell in cells] for _, cells in table.rows], [[float(cell) for cell in row] for row in rows]
    )


def test_decimal_commas_between_commas_are_told(tmp_path):
    path = tmp_path / "rocks.csv"
    path.write_text("ID,X,Y,Diameter\n1,0,1,4,3,0,8\n")
    with pytest.raises(JaxmapError, match=r"7 columns, and 4 names.*line 2.*semicolons"):
        read_rock_lists([path])
