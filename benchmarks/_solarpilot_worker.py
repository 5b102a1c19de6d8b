"""SolarPILOT's flux of one field, for `_solarpilot`.

Runs in an interpreter with NREL-PySAM: ``python _solarpilot_worker.py JOB.json OUT.json``. JOB has
"positions" (east and north, m), "width" and "height" of the mirrors, "slope" (rad), "tower" (height
of the receiver's middle, m), "diameter" and "tall" of the cylinder, and "cells" (rows, columns).
OUT has "layout_s", "sun_s" (seconds for each sun position, beyond the layout), and "suns":
[azimuth and elevation, °, and efficiency of the field]. Written against NREL-PySAM 7.1.
"""

import json
import sys
import tempfile
import time
from pathlib import Path

from PySAM import Solarpilot

#: What the module asks for although it does not change the flux: costs, land, design power.
UNUSED = {
    "q_design": 100.0, "dni_des": 950.0, "rec_hl_perm2": 30.0, "land_max": 20.0, "land_min": 0.1,
    "tower_fixed_cost": 1.0, "tower_exp": 0.01, "rec_ref_cost": 1.0, "rec_ref_area": 1.0,
    "rec_cost_exp": 0.7, "site_spec_cost": 1.0, "heliostat_spec_cost": 1.0, "land_spec_cost": 1.0,
    "contingency_rate": 1.0, "sales_tax_rate": 1.0, "sales_tax_frac": 1.0, "cost_sf_fixed": 0.0,
    "csp_pt_sf_fixed_land_area": 1.0, "csp_pt_sf_land_overhead_factor": 1.0, "is_optimize": 0,
    "flux_max": 1000.0, "opt_init_step": 0.05, "opt_max_iter": 200, "opt_conv_tol": 0.001,
    "opt_algorithm": 1, "opt_flux_penalty": 0.25, "check_max_flux": 0,
}  # fmt: skip
#: One sun position, at noon, on each of two days; fewer days make the module fail.
DAYS, HOURS = 2, 12
DAYS_OF_MONTHS = (31, 28, 31, 30, 31, 30, 31, 31, 30, 31, 30, 31)


def weather(path):
    """Write a year of clear days at 35° north."""
    lines = [
        "Source,Location ID,City,State,Country,Latitude,Longitude,Time Zone,Elevation",
        "none,0,none,none,none,35,-120,-8,0",
        "Year,Month,Day,Hour,Minute,DNI,DHI,GHI,Tdry,Tdew,RH,Pres,Wspd,Wdir,Albedo",
    ]
    for month, days in enumerate(DAYS_OF_MONTHS, 1):
        for day in range(1, days + 1):
            for hour in range(24):
                dni = 950 if 7 <= hour <= 17 else 0
                lines.append(f"2019,{month},{day},{hour},30,{dni},0,0,20,5,30,1013,1,0,0.2")
    path.write_text("\n".join(lines) + "\n", encoding="ascii")


def simulate(job, resource, maps):
    """Return the module after a run, and its seconds."""
    rows, columns = job["cells"]
    module = Solarpilot.new()
    module.SolarPILOT.assign(
        UNUSED
        | {
            "solar_resource_file": str(resource), "helio_positions_in": job["positions"],
            "helio_width": job["width"], "helio_height": job["height"],
            "helio_optical_error": job["slope"], "helio_active_fraction": 1.0, "dens_mirror": 1.0,
            "helio_reflectance": 1.0, "rec_absorptance": 1.0, "h_tower": job["tower"],
            "rec_height": job["tall"], "rec_aspect": job["tall"] / job["diameter"],
            "c_atm_0": 0.006789, "c_atm_1": 0.1046, "c_atm_2": -0.0170, "c_atm_3": 0.002845,
            # Canted and focused at the slant range. A single facet ends the process.
            "n_facet_x": 2, "n_facet_y": 8, "cant_type": 1, "focus_type": 1,
            "n_flux_x": columns, "n_flux_y": rows, "n_flux_days": DAYS, "delta_flux_hrs": HOURS,
            "calc_fluxmaps": int(maps),
        }
    )  # fmt: skip
    start = time.perf_counter()
    module.execute(0)
    return module, time.perf_counter() - start


def main():
    """Run without and with flux maps."""
    job = json.loads(Path(sys.argv[1]).read_text(encoding="utf-8"))
    with tempfile.TemporaryDirectory() as folder:
        resource = Path(folder) / "weather.csv"
        weather(resource)
        _, layout = simulate(job, resource, maps=False)
        module, both = simulate(job, resource, maps=True)
    # Azimuths are counted from the south.
    suns = [(180.0 + a, 90.0 - zenith, e) for a, zenith, e in module.Outputs.opteff_table]
    out = {"layout_s": layout, "sun_s": (both - layout) / len(suns), "suns": suns}
    Path(sys.argv[2]).write_text(json.dumps(out), encoding="utf-8")


if __name__ == "__main__":
    main()
