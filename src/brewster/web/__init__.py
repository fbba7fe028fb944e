"""The web server for two browser pages: one separates photos, one runs the user study. Only this
package uses FastAPI.
"""
