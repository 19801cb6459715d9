"""The dashboard (`app.py`, a Streamlit script), its pages (`views`) and its SQL."""
