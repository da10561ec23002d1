// What several parts share.

export const byId = (id) => document.getElementById(id);

export async function problemText(response) {
  try {
    const problem = await response.json();
    const first = problem.errors?.[0]?.message;
    return first && !problem.detail.includes(first) ? `${problem.detail}: ${first}` : problem.detail;
  } catch {
    return `The service answered ${response.status}. Try again in a moment.`;
  }
}

export async function send(method, url, body) {
  const response = await fetch(url, {
    method,
    headers: { "Content-Type": "application/json" },
    body: body === undefined ? undefined : JSON.stringify(body),
  });
  if (!response.ok) throw new Error(await problemText(response));
  return response.status === 204 ? null : response.json();
}
