// The way to the server: every call bears the token, which came behind the # of the address.
// There stands afterwards which case is open, so that a reload opens it again.
const KEY = "gcar-token";
const given = location.hash.slice(1).split("&"), named = given.find(part => part.startsWith("case="));
const given_token = given.find(part => part && !part.includes("="));
/** Name of the case in the address, null where there is none. */
export const asked = named ? decodeURIComponent(named.slice(5)) : null;
export const address = id => history.replaceState(null, "", id ? `#case=${encodeURIComponent(id)}` : location.pathname);
if (given_token) {
  sessionStorage.setItem(KEY, given_token);
  address(asked);
}
const token = sessionStorage.getItem(KEY) || "";

async function answer(method, path, body) {
  const headers = { Authorization: `Bearer ${token}` };
  let content = body;
  if (body !== undefined && !(body instanceof FormData)) {
    headers["Content-Type"] = "application/json";
    content = JSON.stringify(body);
  }
  let found;
  try { found = await fetch(path, { method, headers, body: content }); } catch {
    throw new Error("The program behind this page does not answer: it was stopped. Start gcar open again; what was done last was not kept.");
  }
  if (!found.ok) {
    let text = `${found.status} ${found.statusText}`;
    try { text = (await found.json()).error.message; } catch { /* no JSON: the status says it */ }
    if (found.status === 401) text = "This page has no token: open the address that gcar open printed.";
    throw new Error(text);
  }
  return found;
}

export const get = async path => (await answer("GET", path)).json();
export const post = async (path, body) => (await answer("POST", path, body)).json();
export const put = async (path, body) => (await answer("PUT", path, body)).json();
export const remove = async path => (await answer("DELETE", path)).json();
/** A picture; null where there is none yet. */
export async function image(path) {
  const found = await answer("GET", path);
  return found.status === 204 ? null : createImageBitmap(await found.blob());
}
export const imageUrl = async path => URL.createObjectURL(await (await answer("GET", path)).blob());

/** Follow a job to its end; tell is called with each state of it. */
export async function follow(job, tell) {
  let now = job;
  tell(now);
  while (now.state === "queued" || now.state === "running") {
    await new Promise(resolve => setTimeout(resolve, 120));
    now = await get(`/api/jobs/${now.id}`);
    tell(now);
  }
  return now;
}
