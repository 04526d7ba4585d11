"""The API's answers as OpenAPI describes them."""
